"""The prefetch process when its file is deleted, restored or replaced, also by another grid."""

import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from children import TIMEOUT
from hapticdb import Environment, PointShell
from hapticdb.errors import GridError
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.session.prefetch import resident_cells
from hapticdb.session.prefetch.fetching import Fetcher, FetchRequest
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.processes.process import Process
from hapticdb.store.sqlite.database_file import remove_file
from naive_frame import touch_of_shell
from session.prefetch.test_fetching import Side, until
from session.worlds import block, ids_by_voxel, make
from voxels import write_voxels


@pytest.fixture
def env(tmp_path: Path) -> Environment:
    made = make(tmp_path)
    write_voxels(made.store, block((50, 50, 58), (78, 78, 63)))
    return made


@pytest.fixture
def cells(env: Environment) -> Iterator[ResidentCells]:
    with ResidentCells(env.url, budget_bytes=LEAST_BUDGET) as made:
        yield made


def replace(env: Environment, folder: Path, bits: int = 7) -> Environment:
    """Replace an environment's file by another environment, with another object; return it open."""
    folder.mkdir()
    other = make(folder, bits=bits)
    middle = other.grid.side // 2
    corner = (middle - 2, middle - 8, middle - 8)
    write_voxels(other.store, block(corner, (middle + 4, middle + 8, middle + 8)))
    other.close()
    env.close()
    remove_file(Path(env.url))
    Path(other.url).rename(env.url)
    return hapticdb.open(env.url)


def served(cells: ResidentCells, shell: PointShell, pose: NDArray[np.float64]) -> Side:
    """A session whose tool is at a pose, with all cells there resident."""
    side = Side(cells.table, cells.grid, shell)
    side.be_at(pose)
    until(lambda: side.is_served)
    return side


def test_fetcher_file_removed_and_restored(
    env: Environment, cells: ResidentCells, sphere: PointShell, tmp_path: Path
) -> None:
    pose = np.eye(4)
    side = served(cells, sphere, pose)
    naive = touch_of_shell(ids_by_voxel(env), env.grid, sphere, pose)
    Path(env.url).rename(tmp_path / "elsewhere")
    until(lambda: cells.database_lost)
    (tmp_path / "elsewhere").rename(env.url)
    until(lambda: not cells.database_lost)
    until(lambda: side.reader.evaluate(pose)[0] == naive.hits)
    assert (cells.figures().losses, cells.restarts) == (1, 0)


def test_fetcher_file_replaced_while_dead(
    env: Environment, cells: ResidentCells, sphere: PointShell, tmp_path: Path
) -> None:
    """Also when the new file gets the old inode number: both have the same revision."""
    pose = np.eye(4)
    side = served(cells, sphere, pose)
    before, revision = side.reader.evaluate(pose)[0], env.store.revision()
    os.kill(cells.pid, signal.SIGKILL)
    assert cells._process.wait(TIMEOUT)
    other = replace(env, tmp_path / "other")
    assert other.store.revision() == revision
    naive = touch_of_shell(ids_by_voxel(other), other.grid, sphere, pose)
    assert naive.hits != before
    until(lambda: side.reader.evaluate(pose)[0] == naive.hits, cells.supervise)
    assert cells.restarts == 1


def test_fetcher_lost_file_stays_open_until_replaced(
    env: Environment, sphere: PointShell, tmp_path: Path
) -> None:
    pose = np.eye(4)
    with CellTable.create(LEAST_BUDGET) as table:
        side = Side(table, env.grid, sphere)
        fetching = Fetcher(FetchRequest(env.url, table, env.grid))
        side.be_at(pose)
        until(lambda: side.is_served, fetching.round)
        before, grid = side.reader.evaluate(pose)[0], env.grid
        env.close()
        remove_file(Path(env.url))
        with pytest.raises(hapticdb.errors.EnvironmentNotFoundError):
            fetching.reopen()
        assert fetching.store.revision() == 1  # SQLite still reads the deleted file
        other = make(tmp_path)
        write_voxels(other.store, block((62, 56, 56), (68, 72, 72)))
        naive = touch_of_shell(ids_by_voxel(other), grid, sphere, pose)
        assert naive.hits != before
        fetching.reopen()
        side.be_at(pose)
        until(lambda: side.is_served, fetching.round)
        assert side.reader.evaluate(pose)[0] == naive.hits
        fetching.close()


def test_fetcher_other_grid_ends_session(
    env: Environment, cells: ResidentCells, tmp_path: Path
) -> None:
    replace(env, tmp_path / "other", bits=6)
    pid = cells.pid
    told: list[str] = []

    def supervise() -> None:
        try:
            cells.supervise()
        except GridError as error:
            told.append(str(error))

    until(lambda: len(told) == 2, supervise)  # each call of `supervise` raises it again
    assert all("another environment than before: start the session again" in t for t in told)
    assert "\n" not in told[0]
    assert (cells.pid, cells.restarts) == (pid, 0)


def test_supervise_threads_start_one_process(
    cells: ResidentCells, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.kill(cells.pid, signal.SIGKILL)
    assert cells._process.wait(TIMEOUT)
    started: list[Process] = []
    barrier = threading.Barrier(4)

    def noted(*given: Any, **named: Any) -> Process:  # noqa: ANN401 - what a `Process` takes
        started.append(Process(*given, **named))
        return started[-1]

    def supervise(_: int) -> None:
        barrier.wait(TIMEOUT)
        cells.supervise()

    monkeypatch.setattr(resident_cells, "Process", noted)
    monkeypatch.setattr(resident_cells, "RESTART_EVERY", 0.0)
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(supervise, range(4)))
    assert len(started) == cells.restarts == 1
    cells.close()
    cells.supervise()
    assert len(started) == 1
