"""Which objects a sweep hits: hit voxels looked up in the database, exactly, and tallied."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.curves import Z_ORDER, encode
from hapticdb.kernels.resident import sweep as kernels
from hapticdb.store.base import BRICK_BYTES, Keys, Store, row_shift

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


def objects_in(store: Store, voxels: Ints, exclude: Keys) -> Pairs:
    """Objects in voxels (V,), packed, those excluded left out; `hits` are indices into `voxels`.

    Two objects in one voxel both count; one that only shares a brick does not.
    """
    ijk = np.empty((len(voxels), 3), dtype=np.int64)
    kernels.unpack(voxels, ijk)
    row_keys = store.grid.encode(ijk) >> row_shift(store.layout)
    distinct = np.unique(row_keys)
    found = [
        _pairs_in(store, row_keys, ijk, distinct[at : at + KEYS_AT_ONCE])
        for at in range(0, len(distinct), KEYS_AT_ONCE)
    ]
    which = np.concatenate([pairs.hits for pairs in found])
    ids = np.concatenate([pairs.ids for pairs in found])
    keep = ~np.isin(ids, exclude)
    order = np.argsort(which[keep], kind="stable")
    return Pairs(which[keep][order], ids[keep][order])


def _pairs_in(store: Store, row_keys: Keys, ijk: Ints, asked: Keys) -> Pairs:
    """Objects in voxels whose row keys (V,) are asked for."""
    keys, row_ids, occupancy = store.lookup(asked)
    starts = np.searchsorted(keys, row_keys)
    counts = np.searchsorted(keys, row_keys, side="right") - starts
    which = np.repeat(np.arange(len(row_keys)), counts)
    rows = np.arange(len(which)) + np.repeat(starts - (np.cumsum(counts) - counts), counts)
    if store.layout == "brick":
        bit = encode(ijk[which] & 7, 3, Z_ORDER)
        is_set = (occupancy[BRICK_BYTES * rows + (bit >> 3)] >> (bit & 7)) & 1
        which, rows = which[is_set > 0], rows[is_set > 0]
    return Pairs(which, row_ids[rows])


def pairs_of_hits(places: Ints, voxel_table: Ints, store: Store, exclude: Keys) -> Pairs:
    """Every hit (H,) with every object in its voxel; places (H,) are where the table has it."""
    filled = np.flatnonzero(voxel_table >= 0)
    in_voxels = objects_in(store, voxel_table[filled], exclude)
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
