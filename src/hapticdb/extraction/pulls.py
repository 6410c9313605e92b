"""Straight pulls: how far a part goes in each direction before something is in the way."""

import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.extraction.directions import (
    AGAINST,
    ALIKE,
    AXES,
    candidate_directions,
    grouped,
    opposed_shares,
)
from hapticdb.extraction.free_space import GROWTH, ContactSpace, FreeSpace
from hapticdb.extraction.leaving import Exit
from hapticdb.extraction.problem import Problem
from hapticdb.sweeps.run import SampleCallback

Floats = NDArray[np.float64]

MOST_OPPOSED = 0.1
"""Greatest share of the contacts at the start that a pull may press against, unless nothing else
leads out. Larger: pulls through thin walls are tried, too; the proof does not take them for
proved."""
BLOCKS = (8, 64)
"""Samples, half a voxel apart, that are looked at together: at first, since most pulls are blocked
soon, and at most; each block is twice as long as the one before."""


class Pull(NamedTuple):
    """A straight pull.

    direction (3,) : unit vector; length : metres until the part is out; touching : metres in
    contact with what it touches at its start; free : metres until the first other hit, `length` if
    there is none; guarded : metres from `touching` on with the guard free, as an interval (2,), or
    None; blockers : ids of the objects at the first hit in the way.
    """

    direction: Floats
    length: float
    touching: float
    free: float
    guarded: tuple[float, float] | None
    blockers: tuple[int, ...]

    @property
    def is_out(self) -> bool:
        """Whether nothing is in the way until the part is out."""
        return self.free >= self.length

    def pose(self, way: float) -> Floats:
        """Displacement (4, 4) after so many metres."""
        return shifted(self.direction * way)


def shifted(shift: Floats) -> Floats:
    """Pose (4, 4) that shifts by (3,) metres."""
    pose = np.eye(4)
    pose[:3, 3] = shift
    return pose


class Pulls:
    """Pulls in all candidate directions, until a deadline.

    Attributes
    ----------
    done : list of Pull
        In the order in which they were tried.
    touched : tuple of int
        Ids of the objects that the part touches where it starts.
    """

    def __init__(
        self, problem: Problem, space: FreeSpace, contact: ContactSpace, leaving: Exit, seed: int
    ) -> None:
        self.done: list[Pull] = []
        self._problem, self._space, self._contact = problem, space, contact
        start, self.touched = contact.start, contact.touched
        self._normals = start.contact_normals
        self._pairs, self._contacts = start.contact_pairs, start.contacts
        self._directions = candidate_directions(self._normals, seed)
        self._lengths = np.maximum(leaving.distances(self._directions), problem.voxel_size)
        self._opposed = opposed_shares(self._directions, self._normals)

    def run(self, until: float, progress: SampleCallback | None) -> None:
        """Try each direction; stops at a time of `time.monotonic`, but tries the first one."""
        total = len(self._directions)
        for n in range(total):
            if self.done and time.monotonic() > until:
                return
            is_opposed = self._opposed[n] > MOST_OPPOSED
            self.done.append(self._blocked(n) if is_opposed else self._pull(n))
            if progress is not None:
                progress(n + 1, total)

    def opposed_out(self, until: float) -> list[Pull]:
        """Pulls that lead out though they press against more than `MOST_OPPOSED` of the contacts.

        Only the axes and the groups of contact normals are tried, because a long slide takes time.
        Contacts are points in voxels: in a recess hardly wider than the part, its front is in
        contact, too. So a pull counts if the part is in contact only where it was at its start. A
        bolt in its bore is; a part that is pulled through something else is not.
        """
        found = []
        likely = np.concatenate([AXES, grouped(self._normals)])
        is_likely = (self._directions @ likely.T >= ALIKE).any(axis=1)
        for n in np.flatnonzero(is_likely & (self._opposed > MOST_OPPOSED)).tolist():
            if time.monotonic() > until:
                break
            pull = self._pull(n)
            if pull.is_out and self._contact.stays(self._in_contact(pull)):
                found.append(pull)
        return found

    def _in_contact(self, pull: Pull) -> Floats:
        """Poses (n, 4, 4) of a pull in contact, half a voxel apart or less."""
        n = int(np.ceil(2.0 * pull.touching / self._problem.voxel_size)) + 1
        return _poses_along(pull.direction, np.linspace(0.0, pull.touching, n))

    def _blocked(self, n: int) -> Pull:
        """A pull that is not tried, because it presses against contacts."""
        direction = self._directions[n]
        return Pull(direction, float(self._lengths[n]), 0.0, 0.0, None, self._opposing(direction))

    def _pull(self, n: int) -> Pull:
        direction, length = self._directions[n], float(self._lengths[n])
        ways = np.linspace(0.0, length, int(np.ceil(2.0 * length / self._problem.voxel_size)) + 1)
        contact = 0  # samples in contact from the start on
        most = -1.0
        for first, end in _blocks(len(ways)):
            block = ways[first:end]
            poses = _poses_along(direction, block)
            slides = 0
            if contact == first:
                hits = self._space.hits(poses)
                most = GROWTH * float(hits[0]) if most < 0.0 else most
                slides = self._slides(poses, hits, most)
            else:  # once out of contact, a pull is free until its first hit
                hits = (~self._space.are_free(poses)).astype(np.int64)
            for at, count in enumerate(hits.tolist(), start=first):
                if count and contact == at and at - first < slides:
                    contact += 1
                elif count:
                    found = self._contact.touch(shifted(direction * ways[at])).objects
                    blockers = tuple(obj.id for obj in found)
                    return self._ended(direction, ways, contact, at, blockers)
        if contact == len(ways):  # still in contact where it should be out
            return Pull(direction, length, length, 0.0, None, self.touched)
        return self._ended(direction, ways, contact, len(ways), ())

    def _slides(self, poses: Floats, hits: NDArray[np.int64], most: float) -> int:
        """Number of the first poses (n, 4, 4) at which the part slides along what it touches."""
        _, n = first_run(np.concatenate([[True], (hits > 0) & (hits <= most)]))
        allowed = self._contact.are_allowed(poses[: n - 1], is_pull=True)
        return int(first_run(np.concatenate([[True], allowed]))[1]) - 1

    def _ended(
        self, direction: Floats, ways: Floats, contact: int, end: int, blockers: tuple[int, ...]
    ) -> Pull:
        """Describe a pull that is free from sample `contact` to the one before `end`."""
        length = float(ways[-1])
        touching = float(ways[contact]) if contact < end else 0.0
        free = length if end == len(ways) else float(ways[end - 1]) * (end > contact)
        guarded = None
        if end > contact:
            poses = _poses_along(direction, ways[contact:end])
            first, last = first_run(self._space.are_free(poses, is_guarded=True))
            if first < last:
                guarded = (float(ways[contact + first]), float(ways[contact + last - 1]))
        return Pull(direction, length, touching, free, guarded, blockers)

    def _opposing(self, direction: Floats) -> tuple[int, ...]:
        """Ids of the objects whose contacts at the start a direction presses against."""
        against = self._contacts[self._normals @ direction < AGAINST]
        pairs = self._pairs[np.isin(self._pairs[:, 0], against)]
        return tuple(np.unique(pairs[:, 1]).tolist())


def _blocks(n: int) -> Iterator[tuple[int, int]]:
    """First and last + 1 sample of each block of `BLOCKS` samples, of n."""
    first, length = 0, BLOCKS[0]
    while first < n:
        yield first, min(first + length, n)
        first, length = first + length, min(2 * length, BLOCKS[1])


def first_run(flags: NDArray[np.bool_]) -> tuple[int, int]:
    """First and last + 1 index of the first run of true flags (n,); equal if there is none."""
    if not flags.any():
        return 0, 0
    first = int(np.argmax(flags))
    length = int(np.argmin(np.append(flags[first:], False)))
    return first, first + length


def _poses_along(direction: Floats, ways: Floats) -> Floats:
    poses = np.tile(np.eye(4), (len(ways), 1, 1))
    poses[:, :3, 3] = ways[:, None] * direction
    return poses
