"""Polar decomposition of placements into a stretch and a rigid pose."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SAME = 1e-7
"""Relative tolerance of equal stretches."""


class Placed(NamedTuple):
    """A placement (4, 4) as pose @ stretch.

    pose : (4, 4) float64, rigid, proper; metres. stretch : (3, 3) float64, symmetric, with its
    first row negated for a mirrored part.
    """

    pose: NDArray[np.float64]
    stretch: NDArray[np.float64]

    @property
    def key(self) -> bytes:
        """Bytes of the rounded stretch, equal for stretches equal up to rounding errors."""
        size = max(float(np.abs(self.stretch).max()), 1e-300)
        # a power of two as the unit: sizes that differ by rounding share it
        exponent = round(math.log2(size))
        steps = np.round(self.stretch / (SAME * 2.0**exponent))
        return np.append(steps, exponent).astype(np.int64).tobytes()


def decompose(transform: NDArray[np.float64]) -> Placed:
    """Polar decomposition of an affine placement (4, 4), also a singular one; read-only."""
    return _decompose(np.asarray(transform, dtype=np.float64).tobytes())


@lru_cache(maxsize=1 << 14)  # 1 kB each
def _decompose(placement: bytes) -> Placed:
    transform = np.frombuffer(placement).reshape(4, 4)
    pose = np.eye(4)
    pose[:3, 3] = transform[:3, 3]
    # A = (U V^T) (V S V^T), which a singular placement has, too
    left, sizes, right = np.linalg.svd(transform[:3, :3])
    rotation = left @ right
    stretch = right.T @ (sizes[:, None] * right)
    if np.linalg.det(rotation) < 0:
        # the reflection goes into the stretch: the pose stays a rotation
        mirror = np.diag([-1.0, 1.0, 1.0])
        rotation, stretch = rotation @ mirror, mirror @ stretch
    pose[:3, :3] = rotation
    pose.flags.writeable = stretch.flags.writeable = False
    return Placed(pose, stretch)
