"""Placements taken apart: what a shape is stretched by, and the rigid rest."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SAME = 1e-7
"""Greatest difference of two stretches that count as one, relative. A larger value shares more
shapes between placements and shows them less exactly."""
REMEMBERED = 1 << 14
"""Placements whose parts are kept, 1 kB each. A larger value saves time in larger scenes."""


class Placed(NamedTuple):
    """A placement (4, 4) as pose @ stretch.

    pose : (4, 4) float64, rigid, proper; metres.
    stretch : (3, 3) float64; a symmetric matrix, with its first row negated for a mirrored part.
    """

    pose: NDArray[np.float64]
    stretch: NDArray[np.float64]

    @property
    def key(self) -> bytes:
        """Bytes that are equal for stretches that differ by rounding alone."""
        size = max(float(np.abs(self.stretch).max()), 1e-300)
        exponent = round(math.log2(size))
        steps = np.round(self.stretch / (SAME * 2.0**exponent))
        return np.append(steps, exponent).astype(np.int64).tobytes()


def taken_apart(transform: NDArray[np.float64]) -> Placed:
    """Polar decomposition of an affine placement (4, 4), which may mirror, scale or flatten.

    Both matrices are read-only.
    """
    return _taken_apart(np.asarray(transform, dtype=np.float64).tobytes())


@lru_cache(maxsize=REMEMBERED)
def _taken_apart(placement: bytes) -> Placed:
    transform = np.frombuffer(placement).reshape(4, 4)
    pose = np.eye(4)
    pose[:3, 3] = transform[:3, 3]
    left, sizes, right = np.linalg.svd(transform[:3, :3])
    rotation = left @ right
    stretch = right.T @ (sizes[:, None] * right)
    if np.linalg.det(rotation) < 0:
        mirror = np.diag([-1.0, 1.0, 1.0])
        rotation, stretch = rotation @ mirror, mirror @ stretch
    pose[:3, :3] = rotation
    pose.flags.writeable = stretch.flags.writeable = False
    return Placed(pose, stretch)


def quaternions(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions w, x, y, z (n, 4) of rotations (n, 3, 3); Shepperd 1978."""
    r = rotations
    trace = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    best = np.argmax(np.stack([trace, r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]], axis=1), axis=1)
    found = np.empty((len(r), 4))
    some = best == 0
    found[some] = np.stack(
        [
            1 + trace[some],
            r[some, 2, 1] - r[some, 1, 2],
            r[some, 0, 2] - r[some, 2, 0],
            r[some, 1, 0] - r[some, 0, 1],
        ],
        axis=1,
    )
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        some = best == i + 1
        found[some, 0] = r[some, k, j] - r[some, j, k]
        found[some, 1 + i] = 1 + r[some, i, i] - r[some, j, j] - r[some, k, k]
        found[some, 1 + j] = r[some, j, i] + r[some, i, j]
        found[some, 1 + k] = r[some, k, i] + r[some, i, k]
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found
