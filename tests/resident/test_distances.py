"""Resident cells with distances: at each centre the least of all objects, after any writes."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from banded import move_points, steps_to, write_points
from hapticdb import Environment
from hapticdb.errors import DatabaseError, UsageError
from hapticdb.grid import CurveName
from hapticdb.kernels.field.lattice import BEYOND, VOXELS_A_STEP
from hapticdb.kernels.resident.cells import UNKNOWN
from hapticdb.kernels.resident.near_voxels import mark_near_voxels
from hapticdb.resident import source
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.store.base import Band, Rows
from hapticdb.store.connect import open_store
from hapticdb.store.objects_at import ids_near_voxels
from session.worlds import block, cells_of, make
from voxels import write_voxels

BUDGET = 8 << 20
"""Bytes of a table: room for 190 cells with distances."""
NOTHING = np.empty(0, dtype=np.int64)
Points = NDArray[np.float64]


@pytest.fixture
def table() -> Iterator[CellTable]:
    with CellTable.create(BUDGET, distances=True) as made:
        yield made


def clumps(env: Environment, n_objects: int = 3, seed: int = 0) -> dict[int, Points]:
    """Objects of points around borders of cells, and one inside a cell: id -> points, voxels."""
    rng = np.random.default_rng(seed)
    written = {}
    for n in range(n_objects):
        middle = 32.0 * rng.integers(0, 1 + (env.grid.side >> 5), (3, 3)) + 4.0 * n
        points = middle[rng.integers(0, 3, 40)] + rng.normal(0.0, 2.0, (40, 3))
        points = np.clip(points, 0.0, env.grid.side - 1e-6)
        written[write_points(env.store, points, f"clump {n}")] = points
    return written


def check(residency: Residency, objects: dict[int, Points]) -> int:
    """Assert that all known cells hold the least distances to all points; count those in slots."""
    table = residency.table
    assert table.cells.payload is not None
    assert (table.cells.payload[0] == BEYOND).all()
    cells, slots = residency.writer.entries()
    points = np.concatenate([np.empty((0, 3)), *objects.values()])
    # in a grid smaller than a cell, no point needs the centres farther out
    inside = (slice(min(residency.grid.side, 32) + 2),) * 3
    for key, slot in zip(cells.tolist(), slots.tolist(), strict=True):
        low = np.array([key >> 32, key >> 16 & 0xFFFF, key & 0xFFFF]) << 5
        near = points[(np.abs(points - low - 16.0) < 24.0).all(axis=1)]
        found = table.cells.payload[slot].reshape(34, 34, 34)
        wanted = steps_to(near, low - 1, 34).reshape(34, 34, 34)
        assert np.array_equal(found[inside], wanted[inside])
    assert table.cells.near is not None
    near_voxels = np.zeros_like(table.cells.near)
    mark_near_voxels(
        slots[slots > 0], table.cells.payload, table.cells.masks, table.cells.words, near_voxels
    )
    filled = np.append(slots[slots > 0], 0)
    assert np.array_equal(table.cells.near[filled], near_voxels[filled])
    return int((slots > 0).sum())


@pytest.mark.parametrize(
    ("bits", "curve", "at_once"),
    [(3, "z", 7), (4, "hilbert", 7), (5, "z", 7), (6, "z", source.ROWS_AT_ONCE), (6, "hilbert", 7)],
)
def test_residency_least_distances_of_objects(
    tmp_path: Path, bits: int, curve: CurveName, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the excluded ones, and however many rows are unpacked together."""
    monkeypatch.setattr(source, "ROWS_AT_ONCE", at_once)
    env = make(tmp_path, bits, "brick", curve)
    objects = clumps(env)
    for exclude in ([2], [1, 2, 3]):
        with CellTable.create(BUDGET, distances=True) as fresh:
            assert fresh.cells.payload is not None
            fresh.cells.payload[1:] = 17  # of cells that were here before
            residency = Residency(env.store, fresh, exclude)
            residency.make_resident(cells_of(env.grid))
            kept = {n: points for n, points in objects.items() if n not in exclude}
            assert (check(residency, kept) > 0) == bool(kept)


def test_residency_distances_follow_moves(tmp_path: Path, table: CellTable) -> None:
    """A voxel moves within its cell, next to a border: the cell beside is read again, too."""
    env = make(tmp_path, 6)
    objects = clumps(env)
    near = np.array([[28.5, 40.5, 40.5]])
    mover = write_points(env.store, near, "mover")
    objects[mover] = near
    residency = Residency(open_store(env.url, read_only=True), table)
    cells = cells_of(env.grid)
    residency.make_resident(cells)
    assert check(residency, objects) > 0
    for place in ([31.5, 40.5, 40.5], [31.9, 31.9, 31.9], [20.5, 20.5, 20.5]):
        objects[mover] = np.array([place])
        move_points(env.store, mover, objects[mover])
        residency.want(cells, residency.slots_of(cells))
        assert residency.refresh() == 1
        assert (residency.slots_of(cells) != UNKNOWN).all()
        assert check(residency, objects) > 0
    env.remove(mover)
    del objects[mover]
    residency.want(NOTHING, NOTHING)
    residency.refresh()
    residency.make_resident(cells)
    check(residency, objects)


def test_residency_distances_after_eviction(tmp_path: Path) -> None:
    env = make(tmp_path)
    objects = clumps(env, 5)
    cells = cells_of(env.grid)
    with CellTable.create(1 << 20, distances=True) as table:
        residency = Residency(env.store, table)
        order = np.random.default_rng(0).permutation(np.tile(np.arange(len(cells)), 2))
        for at in range(0, len(order), 6):
            residency.begin_round()
            residency.load(residency.missing(np.unique(cells[order[at : at + 6]])))
            if at % 24 == 0:
                check(residency, objects)
        assert residency.writer.n_evicted > 0


def test_residency_object_without_distances(tmp_path: Path, table: CellTable) -> None:
    """At the start, and when another user writes it; a table without distances takes it."""
    env = make(tmp_path)
    clumps(env, 1)
    residency = Residency(open_store(env.url, read_only=True), table)
    bare = write_voxels(env.store, block((3, 3, 3), (9, 9, 9)), "bare")
    said = f"object {bare} \\(bare\\) of .* has no distances .*import it again .*'plane'"
    with pytest.raises(UsageError, match=said):
        residency.refresh()
    with CellTable.create(BUDGET, distances=True) as other:
        with pytest.raises(UsageError, match=said):
            Residency(env.store, other)
        Residency(env.store, other, [bare]).make_resident(cells_of(env.grid))
    with CellTable.create(BUDGET) as other:
        Residency(env.store, other).make_resident(cells_of(env.grid))


def test_residency_damaged_distances(
    tmp_path: Path, table: CellTable, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make(tmp_path)
    clumps(env, 1)
    residency = Residency(env.store, table)
    scan = env.store.scan

    def damaged(lows: NDArray[np.int64], highs: NDArray[np.int64], *, distances: bool) -> Rows:
        rows = scan(lows, highs, distances=distances)
        assert rows.distances is not None
        ends = np.arange(1, len(rows) + 1)
        band = Band(np.full(len(rows), 255, dtype=np.uint8), ends)
        return Rows(rows.keys, rows.ids, rows.occupancy, band)

    monkeypatch.setattr(env.store, "scan", damaged, raising=False)
    with pytest.raises(DatabaseError, match=r"is damaged .*run 'hapticdb check"):
        residency.make_resident(cells_of(env.grid))


@pytest.mark.parametrize("curve", ["z", "hilbert"])
def test_ids_near_voxels_equal_brute_force(tmp_path: Path, curve: CurveName) -> None:
    env = make(tmp_path, 6, "brick", curve)
    rng = np.random.default_rng(3)
    objects = {}
    for n in range(4):
        points = rng.uniform(14.0, 34.0, (6, 3))
        objects[write_points(env.store, points, f"points {n}")] = points
    for _ in range(15):
        ijk = rng.integers(12, 36, (2, 3))
        keys = np.unique(env.grid.encode(ijk))
        centres = env.grid.decode(keys) + 0.5
        for within in (0.5, 1.5, 2.37):
            wanted = []
            for object_id, points in objects.items():
                apart = np.linalg.norm(centres[:, None] - points, axis=2)
                is_in = (np.floor(points) == np.floor(centres[:, None])).all(axis=2)
                steps = np.floor(apart / VOXELS_A_STEP + 0.5)
                if (steps <= int(within / VOXELS_A_STEP + 0.5)).any() or is_in.any():
                    wanted.append(object_id)
            exclude = np.array([2])
            found = ids_near_voxels(env.store, keys, exclude, within).tolist()
            assert found == [n for n in wanted if n != 2]
