"""A path between given poses, sampled so densely that no point of the tool skips half a voxel."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.resident import sweep as kernels
from hapticdb.pointshell.shell import PointShell
from hapticdb.poses import as_floats, quaternion_of, rotation_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_SAMPLES = 1e9
"""Greatest number of samples; a longer path is in a wrong unit, or would take days."""
FINEST = 1 << 10
"""Parts of a step at which `SweepPath.at` gives poses. Larger: shorter parts can be looked at."""
RIGID = 1e-6
"""Greatest deviation of a rotation's columns from orthonormal ones; the same as for a frame."""


class Extent(NamedTuple):
    """What a path knows of a shell.

    center (3,) : middle of its bounding box; radius : greatest distance from there of a place
    within the covering radius of a point, metres. Tool frame.
    """

    center: Floats
    radius: float

    @classmethod
    def of(cls, shell: PointShell) -> "Extent":
        """Extent of a shell's points."""
        center = 0.5 * (shell.points.min(axis=0) + shell.points.max(axis=0))
        radius = float(np.sqrt(((shell.points - center) ** 2).sum(axis=1).max()))
        return cls(center, radius + (shell.cover or 0.0))


@dataclass(frozen=True, eq=False)
class SweepPath:
    """M given poses, and samples between them.

    Between two samples, no place on the tool's surface or within the covering radius of a point
    moves more than half a voxel. The middle of the shell's bounding box moves on straight lines;
    the tool turns about the middle evenly, about one axis (slerp). So the motion does not depend on
    the origin of the tool's file. Along a segment, a point at distance r from the middle moves at
    most the middle's distance plus the angle times r; this bound divided by half a voxel, rounded
    up, is the number of steps. Given poses are samples, unchanged.

    Attributes
    ----------
    poses : (M, 4, 4)
        As given, `world_from_tool`.
    motion : (M - 1,)
        Greatest distance that a point may move from each pose to the next, metres.
    starts : (M,) int64
        Index of each pose's sample.
    off : float
        Greatest distance, metres, of a place of the tool at any time from the same place at the
        nearest sample: half a step, a quarter of a voxel or less.
    """

    poses: Floats
    motion: Floats
    starts: Ints
    off: float
    _center: Floats
    _centers: Floats
    _quaternions: Floats
    _turns: Floats
    _travels: Floats
    _slacks: Floats

    @classmethod
    def of(cls, poses: ArrayLike, shell: "PointShell | Extent", voxel_size: float) -> "SweepPath":
        """Path of a shell through poses (M, 4, 4), at least one; voxel size in metres.

        The shell's extent does for many paths of one shell: it is computed from all points.

        Raises
        ------
        UsageError
            If there is no pose, a pose is not rigid, or the path is too long for its voxels.
        """
        given = checked_poses(poses)
        center, radius = shell if isinstance(shell, Extent) else Extent.of(shell)
        rotations = given[:, :3, :3]
        quaternions = quaternion_of(rotations)
        centers = rotations @ center + given[:, :3, 3]
        turns = turns_between(quaternions)
        with np.errstate(over="ignore"):
            motion = np.linalg.norm(np.diff(centers, axis=0), axis=1)
        motion += radius * np.linalg.norm(turns, axis=1)
        # a given rotation differs slightly from its quaternion's, which the samples between use
        off = radius * np.linalg.norm(rotations - rotation_of(quaternions), axis=(1, 2))
        slack = off[:-1] + off[1:]
        step = np.maximum(0.5 * voxel_size - slack, 0.25 * voxel_size)
        with np.errstate(over="ignore"):
            steps = np.maximum(np.ceil(motion / step), 1.0)
            if steps.sum() > MOST_SAMPLES:
                way = np.hypot.reduce(np.diff(centers, axis=0), axis=1).sum()
                raise UsageError(
                    f"the path moves {way:.4g} m, and turns a tool {2.0 * radius:.4g} m across, in "
                    f"voxels of {voxel_size:.4g} m: check the units of path and tool"
                )
        counts = steps.astype(np.int64)
        starts = np.concatenate([[0], np.cumsum(counts)])
        travels = (motion / counts + slack) / voxel_size + kernels.CAUTION
        off = 0.5 * voxel_size * float(travels.max(initial=0.0))
        return cls(
            given, motion, starts, off, center, centers, quaternions, turns,
            np.stack([np.concatenate([[0.0], np.cumsum(travels * counts)])[:-1], travels]),
            slack / voxel_size,
        )  # fmt: skip

    def __len__(self) -> int:
        """Count the samples."""
        return int(self.starts[-1]) + 1

    def sample(self, first: int, last: int) -> Floats:
        """Poses (last - first, 4, 4) of the samples first .. last - 1."""
        out = np.empty((last - first, 4, 4))
        kernels.poses_between(
            self.poses, self._centers, self._quaternions, self._turns, self.starts, self._center,
            first, out,
        )  # fmt: skip
        return out

    def at(self, places: Floats) -> Floats:
        """Poses (n, 4, 4) at places (n,) between samples: multiples of 1 / `FINEST` of a step."""
        out = np.empty((len(places), 4, 4))
        starts = self.starts * FINEST
        for n, place in enumerate(np.rint(places * FINEST).astype(np.int64).tolist()):
            kernels.poses_between(
                self.poses, self._centers, self._quaternions, self._turns, starts, self._center,
                place, out[n : n + 1],
            )  # fmt: skip
        return out

    def reaches(self, places: Floats, halves: Floats) -> tuple[Floats, Floats]:
        """Bounds on movement at places (n,) between samples, voxels.

        The first (n,) is that of any point from the path's start to each place; the second (n,)
        from each place to those up to `halves` (n,) steps before and after it.
        """
        if not len(self.motion):
            return np.zeros(len(places)), np.zeros(len(places))
        last = float(self.starts[-1])
        at = self.segments(np.floor(places))
        spent = self._travels[0, at] + (places - self.starts[at]) * self._travels[1, at]
        ends = [np.clip(places + sign * halves, 0.0, last) for sign in (-1.0, 1.0)]
        steps = [self._travels[1, self.segments(np.floor(end))] for end in ends]
        longest = np.maximum(steps[0], steps[1])  # the steps around a given pose may differ
        return spent, np.where(halves > 0.0, halves * longest + self.slack, 0.0)

    @property
    def slack(self) -> float:
        """Voxels by which the given poses may deviate from the motion between them."""
        return float(self._slacks.max(initial=0.0)) + kernels.CAUTION

    def segments(self, samples: ArrayLike) -> Ints:
        """Segments (n,) of samples (n,), 0 .. M - 2: index of the last given pose before each."""
        found = np.searchsorted(self.starts, np.asarray(samples), side="right") - 1
        return np.asarray(np.clip(found, 0, max(len(self.starts) - 2, 0)))

    def fractions(self, samples: ArrayLike) -> Floats:
        """Share (n,) of the path's motion, 0 .. 1, before each of the samples (n,)."""
        asked = np.asarray(samples)
        total = float(self.motion.sum())
        if total == 0.0:
            return np.zeros(asked.shape)
        before = np.concatenate([[0.0], np.cumsum(self.motion)])
        return np.asarray(np.interp(asked, self.starts, before / before[-1]))

    def travels(self, first: int, last: int) -> Floats:
        """Bound (n,), voxels, on any point's movement until the samples first .. last - 1."""
        if not len(self.motion):
            return np.zeros(last - first)
        samples = np.arange(first, last)
        at = self.segments(samples)
        return np.asarray(self._travels[0, at] + (samples - self.starts[at]) * self._travels[1, at])


def checked_poses(poses: ArrayLike) -> Floats:
    """Check that poses (M, 4, 4) are rigid transforms, and return them."""
    given = as_floats(poses, "a path")
    if given.ndim != 3 or given.shape[1:] != (4, 4) or not len(given):
        raise UsageError(f"a path of shape {given.shape}: give poses (M, 4, 4), one at least")
    rotations = given[:, :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
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


def turns_between(quaternions: Floats) -> Floats:
    """Rotation vectors (M - 1, 3), world frame: smallest turn from each quaternion to the next."""
    aw, a = quaternions[1:, :1], quaternions[1:, 1:]
    bw, b = quaternions[:-1, :1], -quaternions[:-1, 1:]
    w = aw * bw - (a * b).sum(axis=1, keepdims=True)
    v = aw * b + bw * a + np.cross(a, b)
    v = np.where(w < 0.0, -v, v)
    sine = np.linalg.norm(v, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(w))
    return np.asarray(v * np.where(sine < 1e-12, 2.0, angle / np.maximum(sine, 1e-300)))
