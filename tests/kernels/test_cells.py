"""Cells and their directory are compared with a dictionary and a plain set of voxels."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from banded import steps_to
from hapticdb import Grid
from hapticdb.grid import CurveName
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.kernels.field.lattice import BEYOND, CELL_VALUES
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import CELL_WORDS, Place, cell_key, spread_key
from hapticdb.store.base import Layout, row_shift
from naive import Voxel
from realtime.worlds import HIERARCHICAL, cells_of, poses_in

CAPACITY = 16


def colliding(count: int) -> list[int]:
    """Keys whose search begins at the end of a directory of 16 entries, so that it wraps around."""
    ijk = np.random.default_rng(0).integers(0, 1 << 15, (4000, 3))
    keys = [cell_key(i, j, k) for i, j, k in (ijk << 5).tolist()]
    at_end = [int(key) for key in keys if spread_key(np.int64(key), CAPACITY) >= CAPACITY - 2]
    return at_end[:count]


KEYS = colliding(12)
STEP = st.tuples(st.booleans(), st.sampled_from(KEYS), st.integers(0, 99))


@given(st.lists(STEP, max_size=60))
@settings(deadline=None)
def test_a_directory_is_a_dictionary_however_keys_collide(
    steps: list[tuple[bool, int, int]],
) -> None:
    keys = np.full((3, CAPACITY), -1, dtype=np.int64)
    slots = np.zeros((3, CAPACITY), dtype=np.int32)
    known: dict[int, int] = {}
    out = np.empty(len(KEYS), dtype=np.int64)
    for is_new, key, slot in steps:
        one = np.array([key])
        if is_new and (key in known or len(known) < CAPACITY // 2):
            kernels.insert_cells(keys, slots, 1, one, np.array([slot]))
            known[key] = slot
        elif not is_new:
            kernels.remove_cells(keys, slots, 1, one)
            known.pop(key, None)
        kernels.slots_of_cells(keys, slots, 1, np.array(KEYS), out)
        assert out.tolist() == [known.get(k, -1) for k in KEYS]
    assert (keys[[0, 2]] == -1).all()
    assert sorted(keys[1][keys[1] >= 0].tolist()) == sorted(known)


def filled(
    grid: Grid, layout: Layout, objects: list[NDArray[np.int64]], exclude: list[int]
) -> tuple[dict[int, set[Voxel]], dict[int, set[Voxel]]]:
    """Voxels that `fill_cells` puts into each cell, and origins of the bricks in its mask."""
    parts = [rows_of_voxels(ijk, grid, layout) for ijk in objects]
    keys = np.concatenate([rows.keys for rows in parts])
    ids = np.repeat(np.arange(1, len(parts) + 1), [len(rows) for rows in parts])
    width = 64 if layout == "brick" else 0
    bits = np.concatenate([rows.occupancy for rows in parts]).reshape(len(keys), width)
    order = np.lexsort((ids, keys))
    cells = cells_of(grid)
    on_curve = kernels.curve_keys_of_cells(cells, grid.bits, grid.curve_code)
    assert (kernels.cells_of_curve_keys(on_curve, grid.bits, grid.curve_code) == cells).all()
    ascending = np.argsort(on_curve)
    words = np.zeros((len(cells) + 1, CELL_WORDS), dtype=np.uint32)
    masks = np.zeros(len(cells) + 1, dtype=np.uint64)
    kernels.fill_cells(
        keys[order], ids[order], np.frombuffer(bits[order].tobytes(), dtype=np.uint8),
        np.array(exclude, dtype=np.int64), on_curve[ascending], ascending + 1, grid.bits,
        grid.curve_code, row_shift(layout), words, masks,
    )  # fmt: skip
    assert not words[0].any()
    voxels: dict[int, set[Voxel]] = {}
    bricks: dict[int, set[Voxel]] = {}
    for n, key in enumerate(cells.tolist()):
        i, j, k = key >> 32 << 5, (key >> 16 & 0xFFFF) << 5, (key & 0xFFFF) << 5
        set_bits = words[n + 1][:, None] >> np.arange(32, dtype=np.uint32) & 1
        voxels[key] = {
            (i + (w >> 5), j + (w & 31), k + b) for w, b in np.argwhere(set_bits).tolist()
        }
        mask = int(masks[n + 1])
        bricks[key] = {
            (i + (b >> 4) * 8, j + (b >> 2 & 3) * 8, k + (b & 3) * 8)
            for b in range(64)
            if mask >> b & 1
        }
    return voxels, bricks


@pytest.mark.parametrize(("layout", "curve"), HIERARCHICAL)
@given(bits=st.sampled_from([3, 4, 5, 6, 7]), seed=st.integers(0, 99), n_left_out=st.integers(0, 3))
@settings(deadline=None, max_examples=15)
def test_cells_hold_the_voxels_of_their_rows(
    layout: Layout, curve: CurveName, bits: int, seed: int, n_left_out: int
) -> None:
    """This holds at the grid's border, in grids smaller than a cell, and with excluded objects."""
    grid = Grid(0.01, (0.0, 0.0, 0.0), bits, curve)
    rng = np.random.default_rng(seed)
    corners = np.array([[0, 0, 0], [grid.side - 1] * 3])
    objects = [
        np.unique(np.concatenate([corners[:n], rng.integers(0, grid.side, (90, 3))]), axis=0)
        for n in range(3)
    ]
    exclude = sorted(rng.choice([1, 2, 3], n_left_out, replace=False).tolist())
    voxels, bricks = filled(grid, layout, objects, exclude)
    wanted = {
        (i, j, k)
        for n, ijk in enumerate(objects, 1)
        if n not in exclude
        for i, j, k in ijk.tolist()
    }
    for key, found in voxels.items():
        inside = {v for v in wanted if cell_key(*v) == key}
        assert found == inside
        assert bricks[key] == {(i & ~7, j & ~7, k & ~7) for i, j, k in inside}


@given(
    bits=st.sampled_from([3, 4, 5, 6]),
    curve=st.sampled_from(["z", "hilbert"]),
    seed=st.integers(0, 999),
    n_left_out=st.integers(0, 3),
)
@settings(deadline=None, max_examples=12)
def test_cells_hold_the_least_distances_of_their_rows(
    bits: int, curve: CurveName, seed: int, n_left_out: int
) -> None:
    """At all 34^3 centres, though each cell reads only rows of its own bricks."""
    grid = Grid(0.01, (0.0, 0.0, 0.0), bits, curve)
    rng = np.random.default_rng(seed)
    # the second object lies at a border of bricks and of cells
    objects = [rng.uniform(0.0, grid.side, (3, 3)), grid.side / 2 + rng.normal(0.0, 1.0, (3, 3))]
    objects.append(rng.choice([0.0, float(grid.side)], (1, 3)))
    n_bricks = grid.side >> 3
    bricks = 8 * np.argwhere(np.ones((n_bricks, n_bricks, n_bricks)))
    keys = grid.encode(bricks) >> 9
    rows = [
        (key, number, steps)
        for key, brick in zip(keys.tolist(), bricks, strict=True)
        for number, points in enumerate(objects, 1)
        if ((steps := steps_to(points, brick - 1, 10)) != BEYOND).any()
    ]
    rows.sort(key=lambda row: row[:2])
    exclude = sorted(rng.choice([1, 2, 3], n_left_out, replace=False).tolist())
    cells = cells_of(grid)
    on_curve = kernels.curve_keys_of_cells(cells, grid.bits, grid.curve_code)
    ascending = np.argsort(on_curve)
    payload = rng.integers(0, 256, (len(cells) + 1, CELL_VALUES), dtype=np.uint8)
    untouched = payload[0].copy()
    masks = np.zeros(len(cells) + 1, dtype=np.uint64)
    slot = -1
    for part in np.array_split(np.arange(len(rows)), int(rng.integers(1, 4))):  # as a cell is split
        some = [rows[n] for n in part]
        slot = kernels.fill_distances(
            np.array([row[0] for row in some], dtype=np.int64),
            np.array([row[1] for row in some], dtype=np.int64),
            np.array([row[2] for row in some], dtype=np.uint8).reshape(-1, 1000),
            np.array(exclude, dtype=np.int64), on_curve[ascending], ascending + 1, grid.bits,
            grid.curve_code, slot, payload, masks,
        )  # fmt: skip
    assert np.array_equal(payload[0], untouched)
    kept = [points for number, points in enumerate(objects, 1) if number not in exclude]
    for n, key in enumerate(cells.tolist(), 1):
        low = np.array([key >> 32, key >> 16 & 0xFFFF, key & 0xFFFF]) << 5
        wanted = steps_to(np.concatenate([np.empty((0, 3)), *kept]), low - 1, 34)
        # in a grid smaller than a cell, no point needs the centres farther out
        inside = wanted.reshape(34, 34, 34)[tuple([slice(min(grid.side, 32) + 2)] * 3)]
        found = payload[n].reshape(34, 34, 34)[tuple([slice(min(grid.side, 32) + 2)] * 3)]
        assert np.array_equal(found, inside) if masks[n] else (inside == BEYOND).all()
        for bit, brick in enumerate(product(range(4), repeat=3) if bits >= 5 else ()):
            around = wanted.reshape(34, 34, 34)[tuple(slice(8 * b, 8 * b + 10) for b in brick)]
            assert bool(int(masks[n]) >> bit & 1) == (around != BEYOND).any()


@given(st.integers(0, 1000), st.just(0.0) | st.floats(0.1, 16.0))
@settings(max_examples=40)
def test_cells_met_within_reach_are_those_of_the_boxes_around_the_points(
    seed: int, reach: float
) -> None:
    grid = Grid(0.01, (0.0, 0.0, 0.0), 8)
    rng = np.random.default_rng(seed)
    points = np.hstack([rng.normal(0, 0.5, (40, 3)), np.zeros((40, 3))])
    pose = poses_in(grid, 1, seed)
    expected = set()
    for x in (points[:, :3] @ pose[0, :3, :3].T + pose[0, :3, 3]) / grid.voxel_size:
        low = np.maximum(np.floor(x - reach), 0).astype(int)
        high = np.minimum(np.floor(x + reach), grid.side - 1).astype(int)
        if (low <= high).all():
            sides = [range(a // 32, b // 32 + 1) for a, b in zip(low, high, strict=True)]
            expected |= {int(cell_key(32 * i, 32 * j, 32 * k)) for i, j, k in product(*sides)}
    found = np.full(2048, -1, dtype=np.int64)
    place = Place(*grid.origin, grid.voxel_size, float(grid.side))
    assert kernels.cells_met(points, reach, pose, place, found, 500) == (1, len(expected))
    assert set(found[found >= 0].tolist()) == expected


def test_the_clock_passes_over_what_is_wanted_and_gives_used_slots_a_second_round() -> None:
    cells = np.array([-1, 11, 12, -1, 14, 15])  # 0 is the empty slot, 3 is free
    wanted_at = np.array([0, 5, 1, 0, 1, 1])
    used = np.array([0, 0, 1, 0, 0, 0], dtype=np.uint8)
    out = np.empty(6, dtype=np.int64)
    count, hand = kernels.slots_to_free(cells, wanted_at, used, 3, 0, 2, out)
    assert (out[:count].tolist(), hand) == ([4, 5], 5)
    assert used[2] == 0
    count, hand = kernels.slots_to_free(cells, wanted_at, used, 3, hand, 6, out)
    assert out[:count].tolist() == [2]
    assert kernels.slots_to_free(cells, wanted_at, used, 3, hand, 6, out)[0] == 0
