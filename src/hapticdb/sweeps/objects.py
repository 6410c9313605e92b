"""Objects that a sweep hits: looks the hit voxels up in the database, and counts the hits."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.resident import sweep as kernels
from hapticdb.resident.frames import ResidentFrames
from hapticdb.store.base import NO_KEYS, Keys, Store, row_shift
from hapticdb.store.objects_at import pairs_of_voxels

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

KEYS_AT_ONCE = 4096
"""Row keys in one statement. Larger: fewer statements, each one longer."""
JOINED = 2
"""Greatest distance, in samples, of two hits of one interval: a movement of one voxel. Larger:
fewer, longer intervals."""


class Pairs(NamedTuple):
    """P pairs of a hit and an object in its voxel.

    hits (P,) int64: indices of the hits, ascending; ids (P,) int64: of the objects.
    """

    hits: Ints
    ids: Ints


class Runs:
    """Ascending samples as runs; gaps of up to `JOINED` samples do not end a run."""

    def __init__(self) -> None:
        self.count = 0
        self._runs: list[list[int]] = []

    def add(self, samples: Ints) -> None:
        """Add distinct samples (n,), all later than those before."""
        if not len(samples):
            return
        self.count += len(samples)
        cuts = [0, *(np.flatnonzero(np.diff(samples) > JOINED) + 1).tolist(), len(samples)]
        for start, end in pairwise(cuts):
            low, high = int(samples[start]), int(samples[end - 1])
            if self._runs and low - self._runs[-1][1] <= JOINED:
                self._runs[-1][1] = high
            else:
                self._runs.append([low, high])

    def array(self) -> Ints:
        """First and last sample of each run, (K, 2)."""
        return np.array(self._runs, dtype=np.int64).reshape(-1, 2)


class Met:
    """Hits of a sweep on one object.

    hits, contacts : samples that hit the object, and samples in contact with it; points : greatest
    number of the tool's points in its voxels at one sample; deepest : greatest depth below a
    tangent plane, metres.
    """

    def __init__(self) -> None:
        self.hits, self.contacts = Runs(), Runs()
        self.points = 0
        self.deepest = 0.0

    def add(self, samples: Ints, depths: Floats) -> None:
        """Add hits: samples (H,), ascending, and depths (H,), metres."""
        distinct, counts = np.unique(samples, return_counts=True)
        self.hits.add(distinct)
        self.contacts.add(np.unique(samples[depths > 0.0]))
        self.points = max(self.points, int(counts.max()))
        self.deepest = max(self.deepest, float(depths.max()))


def pairs_in_voxels(store: Store, ijk: Ints, exclude: Keys) -> Pairs:
    """Objects in voxels (V, 3), distinct; `hits` are indices into `ijk`.

    Two objects in one voxel both count. An object that only shares a brick with the voxel does not.
    Objects whose ids are in `exclude` (E,) are left out.
    """
    keys = store.grid.encode(ijk)
    order = np.argsort(keys)
    keys = keys[order]
    first_of_row = np.flatnonzero(np.diff(keys >> row_shift(store.layout), prepend=-1))
    cuts = [*first_of_row[::KEYS_AT_ONCE].tolist(), len(keys)]
    which, ids = [NO_KEYS], [NO_KEYS]
    for start, end in pairwise(cuts):
        pairs = pairs_of_voxels(store, keys[start:end], exclude)
        which.append(order[start + pairs[:, 0]])
        ids.append(pairs[:, 1])
    hits = np.concatenate(which)
    by_hit = np.argsort(hits, kind="stable")
    return Pairs(hits[by_hit], np.concatenate(ids)[by_hit])


def find_hits(frames: ResidentFrames, poses: Floats, n_hits: Ints) -> kernels.Found:
    """Hits at poses (B, 4, 4), in the order of the poses; n_hits (B,) are their numbers."""
    samples = np.flatnonzero(n_hits)
    total = int(n_hits.sum())
    room = 1 << (2 * total).bit_length()
    found = kernels.Found(
        np.empty(total, dtype=np.int64),
        np.empty(total, dtype=np.int64),
        np.empty(total, dtype=np.int64),
        np.empty(total),
        np.full(room, -1, dtype=np.int64),
    )
    table = frames.residency.table
    done = count = 0
    while True:
        with table.reading() as row:
            done, count = kernels.find_hits(
                table.cells, row, frames.clusters, poses, samples, frames.residency.place,
                done, count, found,
            )  # fmt: skip
        if done == len(samples):
            return found
        frames.feel(poses[samples[done] : samples[done] + 1])  # fetches evicted cells again


def pairs_of_hits(places: Ints, voxel_table: Ints, store: Store, exclude: Keys) -> Pairs:
    """Pairs of each hit (H,) and each object in its voxel; places (H,) index `voxel_table`."""
    filled = np.flatnonzero(voxel_table >= 0)
    in_voxels = pairs_in_voxels(store, kernels.unpack(voxel_table[filled]), exclude)
    rank = np.empty(len(voxel_table), dtype=np.int64)
    rank[filled] = np.arange(len(filled))
    voxel_of_hit = rank[places]
    n_objects = np.bincount(in_voxels.hits, minlength=len(filled))
    starts, counts = (np.cumsum(n_objects) - n_objects)[voxel_of_hit], n_objects[voxel_of_hit]
    hits = np.repeat(np.arange(len(places)), counts)
    at = np.arange(len(hits)) + np.repeat(starts - (np.cumsum(counts) - counts), counts)
    return Pairs(hits, in_voxels.ids[at])


def tally(met: dict[int, Met], pairs: Pairs, samples: Ints, depths: Floats) -> None:
    """Add pairs to the counts; samples (H,), ascending, and depths (H,), metres, of the hits."""
    order = np.argsort(pairs.ids, kind="stable")
    ids, hits = pairs.ids[order], pairs.hits[order]
    starts = np.flatnonzero(np.diff(ids, prepend=ids[:1] - 1))
    for start, end in zip(starts, np.append(starts[1:], len(ids)), strict=True):
        own = hits[start:end]
        met.setdefault(int(ids[start]), Met()).add(samples[own], depths[own])
