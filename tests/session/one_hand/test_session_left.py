"""Sessions that are not closed, are forked, or fail to end leave nothing behind."""

import contextlib
import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from children import child, exit_code
from hapticdb import Environment, PointShell
from hapticdb.errors import DeviceError, FileError, HapticDBError, UsageError
from hapticdb.recording.file import Recorder, Recording
from hapticdb.resident.table import is_alive
from hapticdb.session import session as module
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.processes import process
from hapticdb.session.session import Session
from session.hands import Noted, Slow, still
from session.sessions import RATE, until

DEEP = 0.0085
"""Height in metres of a hand whose tool reaches into the floor; deeper if smaller."""


def force_in(path: Path) -> float:
    return float(np.abs(np.frombuffer(path.read_bytes()[-48:])).sum()) if path.exists() else 0.0


@pytest.mark.long
def test_session_dropped_leaves_nothing(
    voxel_floor: Environment, sphere: PointShell, tmp_path: Path
) -> None:
    path, record = tmp_path / "wrench", tmp_path / "dropped.hdbrec"
    hand = Noted(still(DEEP), path)
    n_before = n_memories()
    sessions = [Session(voxel_floor.url, sphere, hand, law="plane", rate=RATE, record=record)]
    pids = sessions[0].pid, sessions[0].cells.pid
    until(lambda: sessions[0].n_frames > 100 and force_in(path) > 0, sessions[0])
    n_frames = sessions[0].n_frames
    assert n_memories() == n_before + 2 * len(("cells", "frames"))  # a mapping has one, too
    sessions.clear()
    gc.collect()
    assert path.read_bytes().endswith(bytes(48))
    assert not any(map(is_alive, pids))
    assert n_memories() == n_before
    assert len(Recording(record)) >= n_frames


def n_memories() -> int:
    """Number of this process's file descriptors of shared memories; a mapping has its own."""
    gc.collect()
    found = []
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # the descriptor of this folder itself
            found.append(link.readlink())
    return sum("hapticdb-" in name.name for name in found)


def test_resident_cells_dropped_released(voxel_floor: Environment) -> None:
    n_before = n_memories()
    cells = ResidentCells(voxel_floor.url, budget_bytes=4 << 20)
    pid = cells.pid
    del cells
    assert n_memories() == n_before
    assert not is_alive(pid)


def in_a_fork(work: Callable[[], object]) -> int:
    """Exit status of a forked process that runs `work`."""
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            work()
            status = 0
        finally:
            os._exit(status)
    return exit_code(pid)


@pytest.mark.long
def test_session_forked_copy_does_not_end_it(
    voxel_floor: Environment, sphere: PointShell, tmp_path: Path
) -> None:
    path = tmp_path / "forked.hdbrec"
    with (
        ResidentCells(voxel_floor.url, budget_bytes=4 << 20) as cells,
        Session(cells, sphere, still(DEEP), law="plane", rate=RATE, record=path) as session,
    ):
        until(lambda: session.n_frames > 50, session)

        def leave() -> None:
            session.__exit__()
            cells.__exit__()

        assert in_a_fork(leave) == 0
        n_frames = session.n_frames
        until(lambda: session.n_frames > n_frames + 50, session)
        report = session.stop()
        assert is_alive(cells.pid)
    assert report.recorded_frames == report.loop.frames
    assert len(Recording(path)) == report.loop.frames


def test_session_unclosable_recording_leaves_nothing(
    voxel_floor: Environment, sphere: PointShell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Recorder) -> None:
        raise FileError("no space is left: free some")

    path = tmp_path / "full.hdbrec"
    session = Session(voxel_floor.url, sphere, still(DEEP), law="plane", rate=RATE, record=path)
    pids = session.pid, session.cells.pid
    with monkeypatch.context() as patch:
        patch.setattr(Recorder, "close", full)
        with pytest.raises(FileError, match="no space is left"):
            session.close()
    assert not any(map(is_alive, pids))
    assert session.cells.is_closed
    session.close()


def test_session_two_signals_at_start(
    voxel_floor: Environment, sphere: PointShell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first signal interrupts the start, the second the cleaning up after the first."""
    close, signals = Session.close, iter([KeyboardInterrupt()])

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    def cut_off(session: Session) -> None:
        for signal in signals:
            raise signal
        close(session)  # later calls, when the session is dropped

    path = tmp_path / "never.hdbrec"
    monkeypatch.setattr(module, "WorkerProcess", interrupted)
    monkeypatch.setattr(Session, "close", cut_off)
    with ResidentCells(voxel_floor.url, budget_bytes=4 << 20) as cells:
        with pytest.raises(KeyboardInterrupt):
            Session(cells, sphere, still(DEEP), law="plane", record=path)
        assert not path.exists()


def test_session_hanging_device_named(
    voxel_floor: Environment, sphere: PointShell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "END_TIMEOUT", 0.1)
    monkeypatch.setattr(process, "END_TIMEOUT", 0.1)
    hand = Slow(still(0.03), 50, 60.0)
    with Session(voxel_floor.url, sphere, hand, law="plane", has_baseline=False) as begun:
        until(lambda: begun.n_frames > 5)
        begun.wait(0.2)
        with pytest.raises(DeviceError, match=r"^Slow: a call of read\(\) or apply\(\) takes"):
            begun.stop()


# -- wrong arguments -----------------------------------------------------------------------------


def test_session_closed_cells_refused(voxel_floor: Environment, sphere: PointShell) -> None:
    with ResidentCells(voxel_floor.url, budget_bytes=4 << 20) as cells:
        pass
    with pytest.raises(UsageError, match=r"^these cells are closed: make others$"):
        Session(cells, sphere, still(0.03), law="plane")


@pytest.mark.long
def test_session_slow_process_start_is_not_death(
    voxel_floor: Environment, sphere: PointShell, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ResidentCells(voxel_floor.url, budget_bytes=4 << 20) as cells:
        monkeypatch.setattr(process, "START_TIMEOUT", 0.0)
        for environment, name in ((voxel_floor.url, "prefetch"), (cells, "worker")):
            with pytest.raises(HapticDBError, match=f"^the {name} process was not ready after 0 s"):
                Session(environment, sphere, still(0.03), law="plane")


STARTER = """
import sys
sys.path[:0] = sys.argv[3:]
import hapticdb
from hapticdb.session.session import Session
from session.hands import still
points = hapticdb.PointShell.load(sys.argv[2])
with Session(sys.argv[1], points, still(0.010), law="plane", rate=100.0) as session:
    session.wait(0.2)
    print(session.pid, session.cells.pid, flush=True)
    session.wait(600.0)
"""


@pytest.mark.long
def test_session_processes_end_with_parent(
    voxel_floor: Environment, sphere: PointShell, tmp_path: Path
) -> None:
    sphere.save(tmp_path / "sphere.npz")
    args = [sys.executable, "-c", STARTER, voxel_floor.url, str(tmp_path / "sphere.npz"), *sys.path]
    with child(args, stderr=None) as starter:
        assert starter.stdout is not None
        pids = list(map(int, starter.stdout.readline().split()))
        assert len(pids) == 2
        assert all(map(is_alive, pids))
        starter.kill()
    until(lambda: not any(map(is_alive, pids)))
