"""Comparison of two environments, whatever their engines, layouts and curves."""

import zlib
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import DamagedError
from hapticdb.grid import BRICK_BITS, Grid
from hapticdb.ingest.geometry import unpacked_part
from hapticdb.kernels import curves
from hapticdb.store.base import BRICK_BYTES, Band, Object, Progress, Rows, Store, all_rows
from hapticdb.store.connect import open_store
from hapticdb.store.engines import Url
from hapticdb.transfer import is_same_grid, part_of

Pair = tuple[Object, Object]
Hashes = NDArray[np.uint64]
Sums = tuple[dict[int, int], dict[int, int]]
"""Sums of hashes by object, of both environments."""
ROWS_AT_ONCE = 1 << 14
"""Rows of a batch, 512 bytes each when unpacked."""


def moved_by(a: Object, b: Object) -> NDArray[np.float64]:
    """Metres (3,) from the middle of an object's bounding box to that of the other."""
    return np.asarray(b.bounds.mean(axis=0) - a.bounds.mean(axis=0))


def farthest_corner(a: Object, b: Object) -> float:
    """Largest displacement of a box's corner, metres; more than `moved_by` after a turn."""
    return float(np.linalg.norm(np.abs(b.bounds - a.bounds).max(axis=0)))


@dataclass(frozen=True)
class Difference:
    """Differences of two environments. Objects with the same link and name are the same part."""

    a: str
    b: str
    grids: tuple[Grid, Grid]
    only_in_a: tuple[Object, ...]
    only_in_b: tuple[Object, ...]
    """Parts absent from the other environment."""
    surfaces: tuple[Pair, ...]
    """The same part with another surface: geometry, colours or chord error."""
    moved: tuple[Pair, ...]
    """The same part at another `transform`."""
    attributes: tuple[Pair, ...]
    boxes: tuple[Pair, ...]
    voxels: tuple[Pair, ...]
    distances: tuple[Pair, ...]
    """Other attributes; other boxes, voxels and distances of an equal surface and transform."""
    renumbered: tuple[Pair, ...]
    """The same part with another id, which is no difference."""
    compared: int
    n_voxels: int
    """Objects with the same surface and transform, whose rows were compared; their voxels."""
    with_distances: tuple[int, int]
    """Compared objects with distances in a, and in b."""

    def __repr__(self) -> str:
        return (
            f"Difference(only in a: {len(self.only_in_a)}, only in b: {len(self.only_in_b)}, "
            f"other surfaces: {len(self.surfaces)}, moved: {len(self.moved)}, "
            f"other attributes: {len(self.attributes)}, other voxels: {len(self.voxels)})"
        )

    @property
    def is_same_grid(self) -> bool:
        """Whether both divide space into the same voxels; their order may differ."""
        return is_same_grid(*self.grids)

    @property
    def is_equal(self) -> bool:
        """Whether the contents are equal; ids may differ."""
        return self.is_same_grid and not any((
            self.only_in_a, self.only_in_b, self.surfaces, self.moved, self.attributes, self.boxes,
            self.voxels, self.distances,
        ))  # fmt: skip


def diff_environments(a_url: Url, b_url: Url, *, progress: Progress | None = None) -> Difference:
    """Compare two environments: grids, objects, attributes, surfaces, and rows by their digests.

    Each is read at one revision, surface by surface and in batches of rows, so memory grows with
    the number of objects alone. `progress` gets the number of rows read, and of all.
    """
    with (
        closing(open_store(a_url, read_only=True)) as a,
        closing(open_store(b_url, read_only=True)) as b,
        a.snapshot(),
        b.snapshot(),
    ):
        in_a, in_b = ({part_of(obj): obj for obj in store.objects()} for store in (a, b))
        both = [(obj, in_b[part]) for part, obj in in_a.items() if part in in_b]
        surfaces = _other_surfaces(a, b, both)
        moved = [pair for pair in both if not np.array_equal(pair[0].transform, pair[1].transform)]
        changed = {one.id for one, _ in (*surfaces, *moved)}
        still = [pair for pair in both if pair[0].id not in changed]
        compared = still if is_same_grid(a.grid, b.grid) else []
        voxels, distances = _other_rows(a, b, compared, progress)
        return Difference(
            a=a.url,
            b=b.url,
            grids=(a.grid, b.grid),
            only_in_a=tuple(obj for part, obj in in_a.items() if part not in in_b),
            only_in_b=tuple(obj for part, obj in in_b.items() if part not in in_a),
            surfaces=tuple(surfaces),
            moved=tuple(moved),
            attributes=tuple(pair for pair in both if pair[0].attributes != pair[1].attributes),
            boxes=tuple(p for p in still if not np.array_equal(p[0].bounds, p[1].bounds)),
            voxels=tuple(voxels),
            distances=tuple(distances),
            renumbered=tuple(pair for pair in both if pair[0].id != pair[1].id),
            compared=len(compared),
            n_voxels=sum(obj.voxels for obj, _ in compared),
            with_distances=(
                sum(obj.has_distances for obj, _ in compared),
                sum(obj.has_distances for _, obj in compared),
            ),
        )


def _other_surfaces(a: Store, b: Store, pairs: Sequence[Pair]) -> list[Pair]:
    """Pairs with different digests or stored surfaces; each surface is read once, by itself."""
    same = {one.digest: (one, other) for one, other in pairs if one.digest == other.digest}
    apart = {digest for digest, pair in same.items() if not _is_same_surface(a, b, pair)}
    return [
        (one, other) for one, other in pairs if one.digest != other.digest or one.digest in apart
    ]


def _is_same_surface(a: Store, b: Store, pair: Pair) -> bool:
    digest = pair[0].digest
    in_a, in_b = (store.surfaces([digest]).get(digest) for store in (a, b))
    if in_a is None or in_b is None or in_a == in_b:
        return in_a == in_b
    try:  # packed by another version of zlib
        for store, obj, surface in zip((a, b), pair, (in_a, in_b), strict=True):
            unpacked_part(store.url, obj, surface)
    except DamagedError:
        return False
    return True


def _other_rows(
    a: Store, b: Store, pairs: Sequence[Pair], progress: Progress | None
) -> tuple[list[Pair], list[Pair]]:
    """Pairs with different voxels, and pairs with different distances."""
    measured = [pair for pair in pairs if pair[0].has_distances and pair[1].has_distances]
    done, total = 0, sum(store.size().rows for store in (a, b))
    voxels: Sums = {}, {}
    bands: Sums = {}, {}
    for n, store in enumerate((a, b) if pairs else ()):
        for rows in all_rows(store, ROWS_AT_ONCE):
            _add(voxels[n], rows, _hashes_of(rows, store))
            if rows.distances is not None:
                _add(bands[n], rows, _hashes_of_bands(rows, rows.distances, store))
            done += len(rows)
            if progress is not None:
                progress(min(done, total), total)
    return _apart(pairs, voxels), _apart(measured, bands)


def _apart(pairs: Sequence[Pair], sums: Sums) -> list[Pair]:
    """Pairs with different sums."""
    return [(x, y) for x, y in pairs if sums[0].get(x.id, 0) != sums[1].get(y.id, 0)]


def _add(sums: dict[int, int], rows: Rows, hashes: Hashes) -> None:
    """Add the hashes (R,) of rows to the sums of their objects, independent of their order."""
    ids, of = np.unique(rows.ids, return_inverse=True)
    added = np.zeros(len(ids), np.uint64)
    np.add.at(added, of, hashes)
    for object_id, value in zip(ids.tolist(), added.tolist(), strict=True):
        sums[object_id] = (sums.get(object_id, 0) + value) & (1 << 64) - 1


def _hashes_of(rows: Rows, store: Store) -> Hashes:
    """Sums (R,) of the hashes of each row's voxels, independent of layout and curve."""
    keys = _z_keys(rows, store)
    if store.layout == "voxel":
        return _mixed(keys)
    held = np.unpackbits(rows.occupancy, bitorder="little")
    at = np.flatnonzero(held)
    sums = np.zeros(len(rows), np.uint64)
    of, bit = np.divmod(at, 8 * BRICK_BYTES)
    np.add.at(sums, of, _mixed(keys[of] << 3 * BRICK_BITS | bit))
    return sums


def _hashes_of_bands(rows: Rows, distances: Band, store: Store) -> Hashes:
    """Hashes (R,) of the packed distances of bricks."""
    data, ends = distances.data.tobytes(), distances.ends.tolist()
    crcs = [zlib.crc32(data[at:end]) for at, end in zip([0, *ends], ends, strict=False)]
    return _mixed(_mixed(_z_keys(rows, store)).view(np.int64) ^ np.array(crcs, np.int64))


def _z_keys(rows: Rows, store: Store) -> NDArray[np.int64]:
    """Keys of rows (R,) in Z-order."""
    grid, lower = store.grid, BRICK_BITS if store.layout == "brick" else 0
    level = max(grid.bits - lower, 0)
    places = curves.decode(rows.keys, level, grid.curve_code)
    return np.asarray(curves.encode(places, level, curves.Z_ORDER))


def _mixed(keys: NDArray[np.int64]) -> Hashes:
    """Hashes (n,) of 64 bits (splitmix64, Steele et al. 2014)."""
    found = keys.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        found = (found ^ found >> np.uint64(shift)) * np.uint64(factor)
    return np.asarray(found ^ found >> np.uint64(31))
