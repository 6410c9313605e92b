"""A cell table keeps to its budget; readers of any process join and leave."""

import copy
import itertools
import os
import resource
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from children import TIMEOUT, child, joined, until
from hapticdb.errors import UsageError
from hapticdb.resident.table import LEAST_BUDGET, MOST_READERS, CellTable, is_alive


@given(st.integers(LEAST_BUDGET, 16 << 20), st.booleans())
@settings(deadline=None, max_examples=10)
def test_cell_table_within_budget(budget: int, distances: bool) -> None:
    with CellTable.create(LEAST_BUDGET, distances=distances) as small:
        a_cell = small.size_bytes / small.n_slots
    with CellTable.create(budget, distances=distances) as table:
        assert os.fstat(table.descriptor).st_size == table.size_bytes <= budget
        assert table.n_slots > 0.85 * budget / a_cell
        assert table.capacity >= 4 * table.n_slots
        arrays: list[np.ndarray[Any, Any]] = [
            a for a in (*table.cells, *table.queue) if a is not None
        ]
        ends = sorted((a.ctypes.data, a.ctypes.data + a.nbytes) for a in arrays)
        assert all(a[1] <= b[0] for a, b in itertools.pairwise(ends))
        assert ends[-1][1] - ends[0][0] <= table.size_bytes


def test_cell_table_budget_beyond_memory() -> None:
    with pytest.raises(UsageError, match=r"^a budget of \d+ bytes .*: this machine has \d+$"):
        CellTable.create(1 << 50)


def test_cell_table_file_size_limit() -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, before[1]))
    try:
        with pytest.raises(UsageError, match="ulimit -f"):
            CellTable.create(1 << 26)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_cell_table_reader_rows() -> None:
    with CellTable.create(LEAST_BUDGET) as table:
        rows: list[int] = []
        threads = [
            threading.Thread(target=lambda: rows.append(table.join())) for _ in range(MOST_READERS)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            joined(thread)
        assert sorted(rows) == list(range(MOST_READERS))
        with pytest.raises(UsageError, match=f"{MOST_READERS} readers at most"):
            table.join()
        table.leave(7)
        with table.reading() as row:
            assert row == 7
        assert table.queue.pids[7] == 0


def test_cell_table_row_cleared_for_next_reader() -> None:
    """Nothing is left even if the former reader ended in the middle of a write."""
    with CellTable.create(LEAST_BUDGET) as table:
        row = table.join()
        sessions = table.queue.requests
        sessions[row] = 3  # sets all fields of the row
        sessions["sequence"][row] = 5
        table.leave(row)
        assert table.join() == row
        assert sessions["sequence"][row] == 6
        sessions["sequence"][row] = 0
        assert sessions[row] == np.zeros((), sessions.dtype)


def test_cell_table_dead_reader_releases_lease() -> None:
    """Also for a zombie, whose parent has not waited; living readers keep what they hold."""
    with child([sys.executable, "-c", "pass"]) as gone, CellTable.create(LEAST_BUDGET) as table:
        until(lambda: not is_alive(gone.pid))  # the process is a zombie
        dead, alive = table.join(), table.join()
        table.queue.pids[dead] = gone.pid
        table.cells.readers["version"][[dead, alive]] = 9
        is_active = table.queue.requests["prefetch"]["is_active"]
        is_active[[dead, alive]] = True
        table.release_dead()
        assert np.flatnonzero(table.cells.readers["version"]).tolist() == [alive]
        assert np.flatnonzero(is_active).tolist() == [alive]
        assert table.join() not in {dead, alive}
    assert not is_alive(gone.pid)
    assert is_alive(os.getpid())
    assert is_alive(1)


def test_is_alive_zombie_reaped_meanwhile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with child([sys.executable, "-c", "pass"]) as gone:
        until(lambda: not is_alive(gone.pid))

        def read_text(path: Path) -> str:
            gone.wait(TIMEOUT)
            raise FileNotFoundError(path)

        with monkeypatch.context() as patched:
            patched.setattr(Path, "read_text", read_text)
            assert not is_alive(gone.pid)


def test_cell_table_not_copyable() -> None:
    """A copy in the same process would share its descriptor, and close it twice."""
    with CellTable.create(LEAST_BUDGET) as table:
        for made in (copy.copy, copy.deepcopy):
            with pytest.raises(TypeError, match="cannot be copied"):
                made(table)
        assert table.version == 1
