"""Compares two environments: grids, objects, and every voxel, whatever their layouts and curves."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from operator import eq
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.ingest.geometry import bricks_of_object
from hapticdb.ingest.layout import Bricks
from hapticdb.kernels.surfaces import voxelize
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.store.base import BRICK_BYTES, Object, Progress, Store
from hapticdb.store.connect import open_store
from hapticdb.transfer import Url, is_same_grid, part_of

Pair = tuple[Object, Object]


class VoxelDifference(NamedTuple):
    """One part in both environments: voxels that only one has, and voxels that both have."""

    a: Object
    b: Object
    only_in_a: int
    only_in_b: int
    shared: int

    @property
    def share(self) -> float:
        """Share of the voxels of either that both have, 0 .. 1; 1 if neither has a voxel."""
        total = self.only_in_a + self.only_in_b + self.shared
        return self.shared / total if total else 1.0


class DistanceDifference(NamedTuple):
    """One part in both environments, with other distances to its surface in each."""

    a: Object
    b: Object
    n_rows: int  # bricks whose distances differ, or that only one environment has


class _Totals(NamedTuple):
    """Numbers of voxels summed over all objects; a voxel with two objects counts twice."""

    only_in_a: int
    only_in_b: int
    shared: int
    n_changed: int  # objects that only one environment has, or that differ between them


def moved_by(a: Object, b: Object) -> NDArray[np.float64]:
    """Metres (3,) from the middle of an object's bounding box to that of the other."""
    return np.asarray(b.bounds.mean(axis=0) - a.bounds.mean(axis=0))


def farthest_corner(a: Object, b: Object) -> float:
    """Longest way of a bounding box's corner, metres; longer than `moved_by` after a turn."""
    return float(np.linalg.norm(np.abs(b.bounds - a.bounds).max(axis=0)))


@dataclass(frozen=True)
class Difference:
    """How two environments differ. Objects with the same link and name are the same part."""

    a: str
    b: str
    grids: tuple[Grid, Grid]
    """Voxels are compared only if `is_same_grid`."""
    only_in_a: tuple[Object, ...]
    only_in_b: tuple[Object, ...]
    """Parts that the other environment lacks."""
    changed: tuple[Pair, ...]
    """The same part with another geometry (`digest`)."""
    moved: tuple[Pair, ...]
    """The same geometry in another place (`transform`)."""
    voxels: tuple[VoxelDifference, ...]
    """The same geometry in the same place, but with other voxels."""
    elsewhere: tuple[VoxelDifference, ...]
    """The voxels of the changed and moved parts; empty if the grids are not the same."""
    renumbered: tuple[Pair, ...]
    described: tuple[Pair, ...]
    """The same part with another id, or with other attributes or another bounding box, which change
    no wrench."""
    compared: int
    n_voxels: int
    """Objects with the same geometry in the same place, whose voxels were compared, and these."""
    n_shared: int
    """Voxels of all compared objects that both environments have."""
    distances: tuple[DistanceDifference, ...]
    """The same geometry in the same place, with distances in both environments that differ."""
    with_distances: tuple[int, int]
    """Compared objects that have distances in a, and in b. An object that has them in one
    environment alone is no difference: its voxels are the same."""

    def __repr__(self) -> str:
        return (
            f"Difference(only in a: {len(self.only_in_a)}, only in b: {len(self.only_in_b)}, "
            f"changed: {len(self.changed)}, moved: {len(self.moved)}, "
            f"other voxels: {len(self.voxels)})"
        )

    @property
    def is_same_grid(self) -> bool:
        """Whether both divide space into the same voxels; their order may differ."""
        return is_same_grid(*self.grids)

    @property
    def totals(self) -> _Totals | None:
        """Sums over all objects; None if the grids are not the same."""
        if not self.is_same_grid:
            return None
        both = (*self.voxels, *self.elsewhere)
        lone = [sum(obj.voxels for obj in objects) for objects in (self.only_in_a, self.only_in_b)]
        return _Totals(
            lone[0] + sum(one.only_in_a for one in both),
            lone[1] + sum(one.only_in_b for one in both),
            self.n_shared,
            len(self.only_in_a) + len(self.only_in_b) + len(both),
        )

    @property
    def is_equal(self) -> bool:
        """Whether both hold the same objects, voxels and distances; ids, attributes may differ."""
        parts = (self.only_in_a, self.only_in_b, self.changed, self.moved, self.voxels)
        return self.is_same_grid and not any(parts) and not self.distances


def diff_environments(a_url: Url, b_url: Url, *, progress: Progress | None = None) -> Difference:
    """Compare two environments: their grids, their objects, and every voxel of each object.

    Distances to surfaces are compared where both environments have them for an object in the same
    place. Engines, layouts and curves may differ. Each environment is read at one revision. The
    memory needed is proportional to the largest object. `progress` is called after each object
    whose voxels were compared, with the number of such objects done, and of all. Raises
    `DatabaseError` when one of them cannot be opened or read.
    """
    with (
        closing(open_store(a_url, read_only=True)) as a,
        closing(open_store(b_url, read_only=True)) as b,
        a.snapshot(),
        b.snapshot(),
    ):
        in_a, in_b = ({part_of(obj): obj for obj in store.objects()} for store in (a, b))
        both = [(obj, in_b[part]) for part, obj in in_a.items() if part in in_b]
        same = [pair for pair in both if pair[0].digest == pair[1].digest]
        moved = [pair for pair in same if (pair[0].transform != pair[1].transform).any()]
        changed = [pair for pair in both if pair[0].digest != pair[1].digest]
        still = [pair for pair in same if (pair[0].transform == pair[1].transform).all()]
        is_alike = is_same_grid(a.grid, b.grid)
        compared = still if is_alike else []
        found = _compared(a, b, [*compared, *(changed + moved if is_alike else [])], progress)
        voxels, elsewhere = found[: len(compared)], found[len(compared) :]
        return Difference(
            a=a.url,
            b=b.url,
            grids=(a.grid, b.grid),
            only_in_a=tuple(obj for part, obj in in_a.items() if part not in in_b),
            only_in_b=tuple(obj for part, obj in in_b.items() if part not in in_a),
            changed=tuple(changed),
            moved=tuple(moved),
            voxels=tuple(one for one in voxels if one.only_in_a or one.only_in_b),
            elsewhere=tuple(elsewhere),
            renumbered=tuple(pair for pair in both if pair[0].id != pair[1].id),
            described=tuple(pair for pair in both if _is_described_otherwise(*pair)),
            compared=len(compared),
            n_voxels=sum(obj.voxels for obj, _ in compared),
            n_shared=sum(one.shared for one in found),
            distances=tuple(_distances_apart(a, b, compared)),
            with_distances=(
                sum(obj.has_distances for obj, _ in compared),
                sum(obj.has_distances for _, obj in compared),
            ),
        )


def _is_described_otherwise(a: Object, b: Object) -> bool:
    return a.attributes != b.attributes or not np.array_equal(a.bounds, b.bounds)


def _compared(
    a: Store, b: Store, pairs: Sequence[Pair], progress: Progress | None
) -> list[VoxelDifference]:
    found = []
    stores = [(store, QuantileVector.of(store)) for store in (a, b)] if pairs else []
    for done, pair in enumerate(pairs, start=1):
        of_a, of_b = (bricks_of_object(s, obj, q) for (s, q), obj in zip(stores, pair, strict=True))
        found.append(VoxelDifference(*pair, *_count_apart(of_a, of_b)))
        if progress is not None:
            progress(done, len(pairs))
    return found


def _distances_apart(a: Store, b: Store, pairs: Sequence[Pair]) -> Iterator[DistanceDifference]:
    """Objects whose distances differ, of those that have some in both environments."""
    both = [pair for pair in pairs if pair[0].has_distances and pair[1].has_distances]
    stores = [(store, QuantileVector.of(store)) for store in (a, b)] if both else []
    for pair in both:
        a_bricks, b_bricks = (
            bricks_of_object(store, obj, quantiles, distances=True)
            for (store, quantiles), obj in zip(stores, pair, strict=True)
        )
        if n_rows := _count_rows_apart(a_bricks, b_bricks):
            yield DistanceDifference(*pair, n_rows)


def _count_rows_apart(a: Bricks, b: Bricks) -> int:
    """How many bricks differ in their packed distances, or are only in one of the two."""
    both, at_a, at_b = np.intersect1d(a.keys, b.keys, assume_unique=True, return_indices=True)
    # row by row: a comparison by sets of all rows took a quarter more memory and half more time
    n_alike: int = sum(map(eq, _packed_rows(a, at_a), _packed_rows(b, at_b)))
    return len(a.keys) + len(b.keys) - len(both) - n_alike


def _packed_rows(bricks: Bricks, which: NDArray[np.int64]) -> Iterator[bytes]:
    """Packed distances of the bricks at the given places, in their order."""
    assert bricks.distances is not None  # noqa: S101 - read with distances
    data, ends = bricks.distances.data.tobytes(), bricks.distances.ends[which]
    for start, end in zip(ends - bricks.distances.lengths[which], ends, strict=True):
        yield data[start:end]


def _count_apart(a: Bricks, b: Bricks) -> tuple[int, int, int]:
    """How many voxels are only in a, only in b, and in both."""
    keys = np.union1d(a.keys, b.keys)
    bits = np.zeros((2, len(keys), BRICK_BYTES), dtype=np.uint8)
    for side, bricks in zip(bits, (a, b), strict=True):
        side[np.searchsorted(keys, bricks.keys)] = bricks.occupancy
    count = voxelize.count_voxels
    return count(bits[0] & ~bits[1]), count(bits[1] & ~bits[0]), count(bits[0] & bits[1])
