"""Slots and empty cells: which is evicted first, and when a slot is used again."""

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.resident.slots import ROUNDS_KEPT, CellSlots
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.resident.writer import EmptyCells


def ints(*values: int) -> NDArray[np.int64]:
    return np.array(values, dtype=np.int64)


@pytest.fixture
def table() -> Iterator[CellTable]:
    with CellTable.create(LEAST_BUDGET) as made:
        yield made


def filled(table: CellTable) -> CellSlots:
    """Full slots, whose cells were wanted long ago and have been used by no frame since."""
    slots = CellSlots(table)
    free = slots.next_free(table.n_slots)
    slots.take(free)
    slots.fill(free, 1000 + free)
    for _ in range(ROUNDS_KEPT + 1):
        slots.begin_round()
    table.cells.used[:] = 0
    return slots


def test_a_slot_is_free_once_no_frame_reads_an_older_version(table: CellTable) -> None:
    slots = filled(table)
    slots.clear([3, 4])
    slots.retire([3, 4], version=9)
    slots.free_retired(oldest_version_read=8)
    assert slots.n_free == 0
    slots.free_retired(oldest_version_read=9)
    assert sorted(slots.next_free(9).tolist()) == [3, 4]


def test_what_frames_use_and_what_is_wanted_leaves_last(table: CellTable) -> None:
    slots = filled(table)
    slots.want(ints(1, 2))
    table.cells.used[[3, 4]] = 1
    leaving = slots.cells_to_evict(table.n_slots - 5, 0)
    assert len(leaving) == table.n_slots - 5
    assert not set(leaving.tolist()) & {1001, 1002, 1003, 1004}


@given(
    st.lists(st.lists(st.integers(0, 99), unique=True, max_size=20), max_size=12),
    st.lists(st.integers(0, 99), unique=True, max_size=15),
)
def test_empty_cells_keep_to_their_limit_and_the_urgent_ones_stay(
    arrivals: list[list[int]], urgent: list[int]
) -> None:
    """Urgent cells leave only after all others; the others leave in order of arrival."""
    empty = EmptyCells(40)
    held: list[int] = []
    for cells in arrivals:
        new = [cell for cell in cells if cell not in held]
        leaving = empty.forget_for(len(new), np.array(urgent, dtype=np.int64)).tolist()
        others = [cell for cell in held if cell not in urgent]
        assert leaving[: len(others)] == others[: len(leaving)]
        held = [cell for cell in held if cell not in leaving] + new
        empty.add(new)
        assert empty.keys().tolist() == held
        assert len(empty) <= 40
