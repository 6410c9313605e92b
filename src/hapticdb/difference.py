"""Two environments compared: grids, objects, and every voxel, whatever the layouts and curves."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import BRICK_BITS, CELL_BITS, Grid
from hapticdb.grouping import box_ranges
from hapticdb.kernels import curves, voxelize
from hapticdb.layout import Bricks, bricks_of_rows
from hapticdb.statistics import QuantileVector
from hapticdb.store.base import BRICK_BYTES, Object, Store
from hapticdb.store.connect import open_store
from hapticdb.transfer import (
    Progress,
    ProgressCallback,
    Url,
    are_few_rows,
    is_same_grid,
    is_same_kind,
    part_of,
)

Corner = NDArray[np.int64]
Pair = tuple[Object, Object]
BRICK_EDGE = 1 << BRICK_BITS


class VoxelDifference(NamedTuple):
    """An object that is the same part at the same place, of other voxels: how many each lacks."""

    a: Object
    b: Object
    only_in_a: int
    only_in_b: int


@dataclass(frozen=True)
class Difference:
    """How two environments differ. The same part is what has the same link and name.

    Attributes
    ----------
    a, b : str
        The environments, as messages name them.
    grids : tuple of two Grid
        Theirs; voxels are compared only where `is_same_grid`.
    only_in_a, only_in_b : tuple of Object
        Parts that the other has not.
    changed : tuple of pairs of Object
        The same part with another geometry (`digest`).
    moved : tuple of pairs of Object
        The same geometry in another place (`transform`).
    voxels : tuple of VoxelDifference
        The same geometry at the same place, of other voxels.
    renumbered, described : tuple of pairs of Object
        The same part with another id, or with other attributes or another bounding box:
        differences that nobody feels.
    compared, n_voxels : int
        Objects whose voxels were compared, and those voxels.
    """

    a: str
    b: str
    grids: tuple[Grid, Grid]
    only_in_a: tuple[Object, ...]
    only_in_b: tuple[Object, ...]
    changed: tuple[Pair, ...]
    moved: tuple[Pair, ...]
    voxels: tuple[VoxelDifference, ...]
    renumbered: tuple[Pair, ...]
    described: tuple[Pair, ...]
    compared: int
    n_voxels: int

    @property
    def is_same_grid(self) -> bool:
        """Whether both divide space into the same voxels; their order may differ."""
        return is_same_grid(*self.grids)

    @property
    def is_equal(self) -> bool:
        """Whether both hold the same objects and voxels; ids and attributes may differ."""
        parts = (self.only_in_a, self.only_in_b, self.changed, self.moved, self.voxels)
        return self.is_same_grid and not any(parts)


def diff_environments(
    a_url: Url, b_url: Url, *, progress: ProgressCallback | None = None
) -> Difference:
    """Compare two environments: their grids, their objects, and every voxel of each object.

    Engines, layouts and curves make no difference. Each environment is read at one revision, and
    voxels in batches, whatever the size of an object.

    Parameters
    ----------
    a_url, b_url : str or path
        The environments.
    progress : callable or None
        Called after each object whose voxels were compared.

    Raises
    ------
    DatabaseError
        When one of them cannot be opened or read.
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
        still = [pair for pair in same if (pair[0].transform == pair[1].transform).all()]
        compared = still if is_same_grid(a.grid, b.grid) else []
        voxels = _differing_voxels(a, b, compared, progress)
        return Difference(
            a=a.url,
            b=b.url,
            grids=(a.grid, b.grid),
            only_in_a=tuple(obj for part, obj in in_a.items() if part not in in_b),
            only_in_b=tuple(obj for part, obj in in_b.items() if part not in in_a),
            changed=tuple(pair for pair in both if pair[0].digest != pair[1].digest),
            moved=tuple(moved),
            voxels=tuple(voxels),
            renumbered=tuple(pair for pair in both if pair[0].id != pair[1].id),
            described=tuple(pair for pair in both if _is_described_otherwise(*pair)),
            compared=len(compared),
            n_voxels=sum(obj.voxels for obj, _ in compared),
        )


def _is_described_otherwise(a: Object, b: Object) -> bool:
    return a.attributes != b.attributes or not np.array_equal(a.bounds, b.bounds)


def _differing_voxels(
    a: Store, b: Store, pairs: Sequence[Pair], progress: ProgressCallback | None
) -> list[VoxelDifference]:
    found = []
    n_voxels = 0
    stores = (a, b)
    vectors = [QuantileVector.of(store) for store in stores] if pairs else []
    for done, pair in enumerate(pairs, start=1):
        difference = _compare_voxels(stores, vectors, pair)
        if difference.only_in_a or difference.only_in_b:
            found.append(difference)
        n_voxels += pair[0].voxels
        if progress is not None:
            progress(Progress(done, len(pairs), n_voxels))
    return found


def _compare_voxels(
    stores: tuple[Store, Store], vectors: Sequence[QuantileVector], pair: Pair
) -> VoxelDifference:
    """Compare two objects voxel by voxel, box by box."""
    grid = stores[0].grid
    corners = np.concatenate([grid.voxels_of(obj.bounds) for obj in pair])
    low = np.clip(corners.min(axis=0) - 1, 0, grid.side - 1) & -BRICK_EDGE
    high = np.clip(corners.max(axis=0) + 1, 0, grid.side - 1) | (BRICK_EDGE - 1)
    lacking = np.zeros(2, dtype=np.int64)
    for box in _boxes(stores, vectors, low, high):
        rows_a, rows_b = (
            store.rows_of(obj.id, *box_ranges(store.grid, store.layout, *box))
            for store, obj in zip(stores, pair, strict=True)
        )
        if (
            is_same_kind(*stores)
            and np.array_equal(rows_a.keys, rows_b.keys)
            and np.array_equal(rows_a.occupancy, rows_b.occupancy)
        ):
            continue
        lacking += _count_apart(
            *(
                _inside(bricks_of_rows(rows, store.grid, store.layout), grid, *box)
                for rows, store in zip((rows_a, rows_b), stores, strict=True)
            )
        )
    return VoxelDifference(*pair, *lacking.tolist())


def _boxes(
    stores: Sequence[Store], vectors: Sequence[QuantileVector], low: Corner, high: Corner
) -> Iterator[tuple[Corner, Corner]]:
    """Boxes of whole bricks that make up low .. high (3,), of few enough rows in each store."""
    edges = high - low + 1
    if edges.max() <= 1 << CELL_BITS or all(
        are_few_rows(box_ranges(store.grid, store.layout, low, high), quantiles)
        for store, quantiles in zip(stores, vectors, strict=True)
    ):
        yield low, high
        return
    # in lexicographic order only a slab of one i or more is a range with little else in it
    is_sliced = edges[0] > BRICK_EDGE and not all(store.grid.is_hierarchical for store in stores)
    axis = 0 if is_sliced else int(edges.argmax())
    middle = low[axis] + (edges[axis] // 2 & -BRICK_EDGE)
    first_high, second_low = high.copy(), low.copy()
    first_high[axis], second_low[axis] = middle - 1, middle
    yield from _boxes(stores, vectors, low, first_high)
    yield from _boxes(stores, vectors, second_low, high)


def _inside(bricks: Bricks, grid: Grid, low: Corner, high: Corner) -> Bricks:
    """Those of the bricks that lie in the box: ranges of keys may cover more."""
    corners = (
        curves.decode(bricks.keys, max(grid.bits - BRICK_BITS, 0), curves.Z_ORDER) << BRICK_BITS
    )
    mine = ((corners >= low) & (corners <= high)).all(axis=1)
    return Bricks(bricks.keys[mine], bricks.occupancy[mine])


def _count_apart(a: Bricks, b: Bricks) -> tuple[int, int]:
    """How many voxels are only in a, and only in b."""
    keys = np.union1d(a.keys, b.keys)
    bits = np.zeros((2, len(keys), BRICK_BYTES), dtype=np.uint8)
    for side, bricks in zip(bits, (a, b), strict=True):
        side[np.searchsorted(keys, bricks.keys)] = bricks.occupancy
    count = voxelize.count_voxels
    return count(bits[0] & ~bits[1]), count(bits[1] & ~bits[0])
