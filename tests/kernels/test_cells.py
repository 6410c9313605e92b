"""The directory of cells, the cells that points meet, and the slots that are freed."""

from itertools import product

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticdb import Grid
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import CellGrid, cell_key, spread_key
from session.worlds import poses_in

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
def test_cell_directory_equals_dict_under_collisions(
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


@given(st.integers(0, 1000), st.just(0.0) | st.floats(0.1, 16.0))
@settings(max_examples=40)
def test_cells_within_reach_cover_point_boxes(seed: int, reach: float) -> None:
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
    place = CellGrid(*grid.origin, grid.voxel_size, float(grid.side))
    assert kernels.cells_in_reach(points, 0, 40, reach, pose, place, found, 500) == (
        1,
        len(expected),
    )
    assert set(found[found >= 0].tolist()) == expected


def test_slots_to_free_second_chance() -> None:
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
