"""Straight pulls: free length of a part in each direction, and the objects in its way."""

import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.array_types import Floats
from hapticdb.extraction.directions import (
    AGAINST,
    ALIKE,
    AXES,
    candidate_directions,
    likely_directions,
    opposed_shares,
)
from hapticdb.extraction.extraction_results import RemovalPath, ids_of
from hapticdb.extraction.free_space import STEP, FreeSpace
from hapticdb.extraction.problem import Exit, Problem
from hapticdb.extraction.proof import prove
from hapticdb.store.base import Progress

GROWTH = 1.2
"""Factor of the start's hits up to which a part slides along its contacts. Larger: more refuted
pulls."""
MOST_OPPOSED = 0.1
"""Greatest share of opposing contacts at the start of a pull. Larger: more refuted pulls."""
MOST_LIKELY = 24
"""Pulls along likely directions that are swept, at most. Larger: more oblique bores and sweeps."""
SHARE_OF_PULL = 0.5
"""Share of the remaining time for the sweep of one of them."""
BLOCKS = (8, 64)
"""Poses of the first check, since most pulls are blocked soon, doubled up to those of the last."""


class Pull(NamedTuple):
    """A straight pull.

    direction (3,) : unit vector; length : metres until the part is out; contact_length : metres in
    contact with the objects touched at the start; free : metres until the first other hit, `length`
    without one; blockers : ids of the objects at the first hit; is_swept : measured on surfaces,
    not voxels.
    """

    direction: Floats
    length: float
    contact_length: float
    free: float
    blockers: tuple[int, ...]
    is_swept: bool = False

    @property
    def is_out(self) -> bool:
        """Whether the pull is free until the part is out."""
        return self.free >= self.length

    def poses(self, distances: Floats) -> Floats:
        """Displacements (n, 4, 4) after (n,) metres."""
        return poses_along(self.direction, distances)


class Pulls:
    """Pulls in all candidate directions, until a deadline.

    done : in the order of trial, swept ones first.
    """

    def __init__(self, problem: Problem, space: FreeSpace, leaving: Exit, seed: int) -> None:
        self.done: list[Pull] = []
        self._swept: set[int] = set()
        self._problem, self._space, self._step = problem, space, STEP * problem.voxel_size
        normals, own = space.start.contact_normals, problem.own_axes
        self._directions = candidate_directions(normals, own, seed)
        alike = self._directions @ likely_directions(normals, own).T
        self._is_likely = alike.max(axis=1) >= ALIKE
        self._is_axis = (
            np.abs(self._directions @ np.concatenate([own, AXES]).T).max(axis=1) >= ALIKE
        )
        self._lengths = np.maximum(leaving.distances(self._directions), problem.voxel_size)
        self._opposed = opposed_shares(self._directions, normals)

    def run(self, until: float, progress: Progress | None) -> None:
        """Try the other directions by voxels, at least one; until a time of `time.monotonic`."""
        total = len(self._directions)
        for n in range(total):
            if n in self._swept:
                continue
            # at least one, so that a result names what is in the way
            if self.done and time.monotonic() > until:
                return
            self.done.append(self._pull(n))
            if progress is not None:
                progress(len(self.done), total)

    def sweep(self, until: float) -> RemovalPath | None:
        """Sweep likely pulls until one is free; None without one, or at a time of `time.monotonic`.

        Axes come first, then directions with few opposing contacts, shorter pulls first.
        """
        likely = np.flatnonzero(self._is_likely)
        # the last key of lexsort counts first
        order = np.lexsort(
            (self._lengths[likely], np.round(self._opposed[likely], 2), ~self._is_axis[likely])
        )
        for tried, n in enumerate(likely[order[:MOST_LIKELY]].tolist()):
            if tried and time.monotonic() > until:
                return None
            direction, length = self._directions[n], float(self._lengths[n])
            now = time.monotonic()
            poses = poses_along(direction, np.array([0.0, length]))
            proved = prove(
                self._problem, poses, "pull", now + SHARE_OF_PULL * max(until - now, 0.0)
            )
            if not (proved.obstacles or proved.swept.is_free):
                continue  # undecided: out of time
            self._swept.add(n)
            blockers = ids_of(proved.obstacles[:1])  # it ends at the first
            free = proved.free_share * length
            self.done.append(Pull(direction, length, 0.0, free, blockers, is_swept=True))
            if proved.swept.is_free:
                return proved
        return None

    def _pull(self, n: int) -> Pull:
        direction, length = self._directions[n], float(self._lengths[n])
        contact_length, free, blockers = 0.0, 0.0, self._opposing(direction)
        if self._opposed[n] <= MOST_OPPOSED:  # else blocked at the start
            distances = np.linspace(0.0, length, int(np.ceil(length / self._step)) + 1)
            contact, end = self._followed(direction, distances)
            if contact == len(distances):  # in contact all the way
                contact_length, blockers = length, ids_of(self._space.start.objects)
            else:
                contact_length = float(distances[contact]) if contact < end else 0.0
                free = float(distances[end - 1]) * (end > contact)
                blockers = ()
                if end < len(distances):
                    hit = self._space.touch(shifted(direction * distances[end]))
                    blockers = ids_of(hit.objects)
        return Pull(direction, length, contact_length, free, blockers)

    def _followed(self, direction: Floats, distances: Floats) -> tuple[int, int]:
        """Numbers of the poses in contact from the start and before a hit, after (n,) metres."""
        # sliding lasts while the hits stay within GROWTH times those at the start
        contact, most, room = 0, -1.0, self._space.room
        for first, end in _blocks(len(distances)):
            poses = poses_along(direction, distances[first:end])
            slides = 0
            if contact == first:
                hits = room.hits(poses)
                most = GROWTH * float(hits[0]) if most < 0.0 else most
                is_hit = hits > 0
                slides = int(np.argmin(np.append(is_hit & (hits <= most), False)))
            else:  # once out of contact, a pull is free until its first hit
                is_hit = ~room.are_free(poses)
            contact += slides
            later = np.flatnonzero(is_hit[slides:])
            if len(later):
                return contact, first + slides + int(later[0])
        return contact, len(distances)

    def _opposing(self, direction: Floats) -> tuple[int, ...]:
        """Ids of the objects with contacts at the start opposed to a direction."""
        start = self._space.start
        # contact_pairs has the points' indices first: those of opposing contacts choose the objects
        against = start.contacts[start.contact_normals @ direction < AGAINST]
        pairs = start.contact_pairs[np.isin(start.contact_pairs[:, 0], against)]
        return tuple(np.unique(pairs[:, 1]).tolist())


def _blocks(n: int) -> Iterator[tuple[int, int]]:
    """First and last + 1 pose of each block of `BLOCKS` poses, of n."""
    first, length = 0, BLOCKS[0]
    while first < n:
        yield first, min(first + length, n)
        first, length = first + length, min(2 * length, BLOCKS[1])


def first_run(flags: NDArray[np.bool_]) -> tuple[int, int]:
    """First and last + 1 index of the first run of true flags (n,); equal without one."""
    if not flags.any():
        return 0, 0
    first = int(np.argmax(flags))
    length = int(np.argmin(np.append(flags[first:], False)))
    return first, first + length


def shifted(shift: Floats) -> Floats:
    """Pose (4, 4) of a shift (3,), metres."""
    return np.asarray(poses_along(shift, np.ones(1))[0])


def poses_along(direction: Floats, distances: Floats) -> Floats:
    """Poses (n, 4, 4) of shifts by (n,) metres in a direction (3,)."""
    poses = np.tile(np.eye(4), (len(distances), 1, 1))
    poses[:, :3, 3] = distances[:, None] * direction
    return poses
