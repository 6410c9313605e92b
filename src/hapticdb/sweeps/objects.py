"""Which objects a sweep hits: hit voxels looked up in the database, exactly, and tallied."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.resident import sweep as kernels
from hapticdb.store.base import NO_KEYS, Keys, Store, row_shift
from hapticdb.store.objects_at import pairs_of_voxels

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

KEYS_AT_ONCE = 4096
"""Row keys that one statement asks for."""
JOINED = 2
"""Samples between two hits that leave them one interval: a voxel's way."""


class Pairs(NamedTuple):
    """Every hit with every object in its voxel, P of them.

    hits (P,) int64: which hit, ascending; ids (P,) int64.
    """

    hits: Ints
    ids: Ints


class Runs:
    """Samples, ascending, as runs without gaps to speak of."""

    def __init__(self) -> None:
        self.count = 0
        self._runs: list[list[int]] = []

    def add(self, samples: Ints) -> None:
        """Count distinct samples (n,) in, all after those before."""
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
    """What a sweep had to do with one object.

    hits, contacts : samples that hit it, that were in contact with it; points : most of the tool's
    points in its voxels at one sample; deepest : metres below a tangent plane, of its deepest hit.
    """

    def __init__(self) -> None:
        self.hits, self.contacts = Runs(), Runs()
        self.points = 0
        self.deepest = 0.0

    def add(self, samples: Ints, depths: Floats) -> None:
        """Count hits in: samples (H,), ascending, and depths (H,), metres."""
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


def pairs_of_hits(places: Ints, voxel_table: Ints, store: Store, exclude: Keys) -> Pairs:
    """Every hit (H,) with every object in its voxel; places (H,) are where the table has it."""
    filled = np.flatnonzero(voxel_table >= 0)
    ijk = np.empty((len(filled), 3), dtype=np.int64)
    kernels.unpack(voxel_table[filled], ijk)
    in_voxels = pairs_in_voxels(store, ijk, exclude)
    rank = np.empty(len(voxel_table), dtype=np.int64)
    rank[filled] = np.arange(len(filled))
    voxel_of_hit = rank[places]
    n_objects = np.bincount(in_voxels.hits, minlength=len(filled))
    starts, counts = (np.cumsum(n_objects) - n_objects)[voxel_of_hit], n_objects[voxel_of_hit]
    hits = np.repeat(np.arange(len(places)), counts)
    at = np.arange(len(hits)) + np.repeat(starts - (np.cumsum(counts) - counts), counts)
    return Pairs(hits, in_voxels.ids[at])


def tally(met: dict[int, Met], pairs: Pairs, samples: Ints, depths: Floats) -> None:
    """Count pairs in; samples, ascending, and depths are the hits' (H,)."""
    order = np.argsort(pairs.ids, kind="stable")
    ids, hits = pairs.ids[order], pairs.hits[order]
    starts = np.flatnonzero(np.diff(ids, prepend=ids[:1] - 1))
    for start, end in zip(starts, np.append(starts[1:], len(ids)), strict=True):
        own = hits[start:end]
        met.setdefault(int(ids[start]), Met()).add(samples[own], depths[own])
