"""Paths of rigid motion, parameterised by an upper bound on the motion of any tool point."""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.triangles.path_motion import PathMotion, poses_kernel
from hapticdb.poses import as_floats, quaternion_of, rotation_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

RIGID = 1e-6
"""Greatest deviation of a rotation's columns from orthonormal ones; the same as for a frame."""
MUCH, HALF_TURN = 170.0, 179.99
"""Degrees between two poses: from the first on a doubtful turn, beyond the second half a turn."""
AT_ONCE = 64
"""Segments of a batch of turns. Larger: more memory."""


@dataclass(frozen=True, eq=False)
class SampledPath:
    """M given samples of a motion, linear in between.

    parameters (M,) : path parameter at each, metres, ascending; poses (M, J) : joint values.
    """

    parameters: Floats
    poses: Floats

    @property
    def length(self) -> float:
        """Metres at the last sample."""
        return float(self.parameters[-1])

    def segments(self, parameters: Floats) -> Ints:
        """Segments (n,) of path parameters (n,), 0 .. M - 2: the last sample before each."""
        # right: equal parameters are a rest, and its last pose begins the motion
        found = np.searchsorted(self.parameters, parameters, side="right") - 1
        return np.asarray(np.clip(found, 0, max(len(self.parameters) - 2, 0)))

    def fraction(self, parameter: float) -> float:
        """Share of the path's motion before a path parameter, 0 .. 1."""
        return min(parameter / self.length, 1.0) if self.length > 0.0 else 0.0

    def at(self, parameters: ArrayLike) -> Floats:
        """Samples (n, J) at path parameters (n,), clamped to the ends of the path."""
        given = np.asarray(parameters, dtype=np.float64)
        return np.stack([np.interp(given, self.parameters, one) for one in self.poses.T], axis=-1)


@dataclass(frozen=True, eq=False)
class ToolPath(SampledPath):
    """M given poses and the motion between them.

    The tool's `center` moves on straight lines, and the tool turns about it evenly, about one axis
    (slerp). Rotations are made orthonormal first; a given one may deviate by 1e-6.

    Attributes
    ----------
    parameters : (M,)
        Path parameter at each given pose, metres: no place of the tool moves more than the
        difference from one to the next.
    poses : (M, 4, 4)
        As given, `world_from_tool`; none of a machine's link.
    motion : PathMotion
        The same for kernels.
    """

    motion: PathMotion

    @classmethod
    def of(cls, poses: ArrayLike, corners: Floats, center: Floats) -> "ToolPath":
        """Motion of a tool with corners (V, 3) through poses (M, 4, 4); center (3,), its frame.

        Raises `UsageError` if there is no pose, a pose is not rigid, or the path is too long for
        numbers.
        """
        given = checked_poses(poses)
        return cls.joined([given], corners, center, given)

    @classmethod
    def joined(
        cls, pieces: Iterable[Floats], corners: Floats, center: Floats, given: Floats
    ) -> "ToolPath":
        """The same through pieces, each from the last pose of the one before; given : `poses`."""
        parts: list[tuple[Floats, ...]] = []
        for poses in pieces:
            quaternions, first = quaternion_of(poses[:, :3, :3]), int(bool(parts))
            centers = poses[:, :3, :3] @ center + poses[:, :3, 3]
            turns, rotations = _turns_between(quaternions), rotation_of(quaternions)
            with np.errstate(over="ignore"):
                motion = np.linalg.norm(np.diff(centers, axis=0), axis=1)
            motion += _turned(corners - center, turns, rotations[:-1])
            parts.append((motion, centers[first:], rotations[first:], turns))
        motion, centers, rotations, turns = map(np.concatenate, zip(*parts, strict=True))
        parameters = np.concatenate([[0.0], np.cumsum(motion)])
        if not np.isfinite(parameters[-1]):
            raise UsageError("the path is longer than numbers go: check its unit")
        moved = [parameters, centers, rotations, turns]
        if len(parameters) == 1:  # two poses at least
            moved = [*(np.repeat(one, 2, axis=0) for one in moved[:3]), np.zeros((1, 3))]
        return cls(parameters, given, PathMotion(*map(np.ascontiguousarray, (*moved, center))))

    def checked(self) -> "ToolPath":
        """Itself; a warning for a turn of 170 degrees, and UsageError for one of 180.

        A turn takes the short way, and half a turn has none.
        """
        degrees = np.degrees(np.linalg.norm(self.motion.turns, axis=1))
        n = int(np.argmax(degrees))
        steps = f"from pose {n} to pose {n + 1} the path turns by {degrees[n]:.5g} degrees"
        if degrees[n] > HALF_TURN:
            raise UsageError(f"{steps}, either way: give a pose between")
        if degrees[n] >= MUCH:
            warnings.warn(f"{steps}, the short way: is it the right one?", stacklevel=3)
        return self

    def at(self, parameters: ArrayLike) -> Floats:
        """Poses (n, 4, 4) at path parameters (n,), clamped to the ends of the path."""
        parameters = np.array(parameters, dtype=np.float64)
        out = np.tile(np.eye(4), (len(parameters), 1, 1))
        poses_kernel(self.motion, self.segments(parameters), parameters, out)
        return out


def checked_poses(poses: ArrayLike) -> Floats:
    """Check poses (M, 4, 4) for rigid transforms, and return them."""
    given = as_floats(poses, "a path")
    if given.ndim != 3 or given.shape[1:] != (4, 4) or not len(given):
        raise UsageError(f"a path of shape {given.shape}: give poses (M, 4, 4), one at least")
    rotations = given[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        # orthonormal and of positive determinant: a mirror has no quaternion
        products = np.swapaxes(rotations, 1, 2) @ rotations
        is_rigid = (
            np.isfinite(given).all(axis=(1, 2))
            & (np.abs(products - np.eye(3)).max(axis=(1, 2)) <= RIGID)
            & (np.linalg.det(np.nan_to_num(rotations)) > 0.0)
            & (given[:, 3] == (0.0, 0.0, 0.0, 1.0)).all(axis=1)
        )
    bad = np.flatnonzero(~is_rigid)
    if len(bad):
        raise UsageError(f"pose {bad[0]} of the path is no rigid transform: give a rotation")
    return given


def _turns_between(quaternions: Floats) -> Floats:
    """Rotation vectors (M - 1, 3), world frame: smallest turn from each quaternion to the next."""
    aw, a = quaternions[1:, :1], quaternions[1:, 1:]
    bw, b = quaternions[:-1, :1], -quaternions[:-1, 1:]
    w = aw * bw - (a * b).sum(axis=1, keepdims=True)
    v = aw * b + bw * a + np.cross(a, b)
    # q and -q are one rotation: w >= 0 is the short way
    v = np.where(w < 0.0, -v, v)
    sine = np.linalg.norm(v, axis=1, keepdims=True)
    # atan2, not acos of w: that loses half the digits of a small angle
    angle = 2.0 * np.arctan2(sine, np.abs(w))
    # limit of angle / sine at 0, where the quotient is 0 / 0
    return np.asarray(v * np.where(sine < 1e-12, 2.0, angle / np.maximum(sine, 1e-300)))


def _turned(corners: Floats, turns: Floats, rotations: Floats) -> Floats:
    """Greatest motion (M - 1,) of corners (V, 3) about the centre in each turn, metres."""
    angles = np.linalg.norm(turns, axis=1)
    out = np.zeros(len(turns))
    turning = np.flatnonzero(angles > 0.0)
    if not len(turning):
        return out
    squares = (corners**2).sum(axis=1)
    # transposed rotation: world axis into the tool's frame, where the corners are
    axes = np.einsum("nij,ni->nj", rotations[turning], turns[turning] / angles[turning, None])
    for at in range(0, len(turning), AT_ONCE):
        along = corners @ axes[at : at + AT_ONCE].T
        # distance from the axis; arc length is angle times radius. Rounding may give less than 0
        beside = np.sqrt(np.maximum(squares[:, None] - along**2, 0.0).max(axis=0))
        out[turning[at : at + AT_ONCE]] = angles[turning[at : at + AT_ONCE]] * beside
    # never below the true motion: parameters are upper bounds
    return out * (1.0 + 1e-9)
