"""Sessions: complete, cut short, or with one of their processes killed; each a few seconds."""

import json
import math
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numba import typeof

from children import TIMEOUT
from hapticdb import Environment, PointShell
from hapticdb.errors import DeviceError, HapticDBError, UsageError
from hapticdb.kernels.period.loop import _layout_of
from hapticdb.query.law import LawName
from hapticdb.recording.file import Recorder, Recording
from hapticdb.recording.frame import State
from hapticdb.recording.header import Header
from hapticdb.resident.table import is_alive
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.report import Report
from hapticdb.session.session import Session
from hapticdb.tabular.schema import plain
from recordings import motion, write
from session import users_law
from session.hands import Unplugged, still, stroking
from session.sessions import NEVER_STALE, RATE, Recorded, recorded, until


@pytest.fixture(scope="module")
def cells(voxel_floor: Environment) -> Iterator[ResidentCells]:
    with ResidentCells(voxel_floor.url, budget_bytes=4 << 20) as made:
        yield made


class Played(NamedTuple):
    """Results of a session that ended with its device."""

    report: Report
    frames: Recorded
    recording: Recording
    loop_pid: int


@pytest.fixture(scope="module")
def played(
    cells: ResidentCells, sphere: PointShell, tmp_path_factory: pytest.TempPathFactory
) -> Played:
    """A session that moves 2 mm deep over the floor until the device's end."""
    return play(cells, sphere, tmp_path_factory.mktemp("played") / "session.hdbrec", "plane")


@pytest.fixture(scope="module", params=["plane", "distance"])
def by_law(
    request: pytest.FixtureRequest, sphere: PointShell, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Played]:
    """The same session over voxels, rendered directly, and over distances, with a coupling."""
    if request.param == "plane":
        yield request.getfixturevalue("played")
        return
    url = request.getfixturevalue("distance_floor").url
    with ResidentCells(url, budget_bytes=4 << 20) as cells:
        yield play(cells, sphere, tmp_path_factory.mktemp("d") / "session.hdbrec", "distance")


def play(cells: ResidentCells, shell: PointShell, path: Path, law: LawName) -> Played:
    """Move over the floor until the device's end."""
    with Session(
        cells, shell, stroking(0.010), law=law, rate=RATE, record=path, staleness=NEVER_STALE
    ) as session:
        pid = session.pid
        report = session.wait(TIMEOUT)
    assert report is not None
    recording = Recording(path)
    return Played(report, recorded(path), recording, pid)


# -- sessions without disturbance --------------------------------------------------------------


def test_session_ends_with_device(by_law: Played) -> None:
    loop = by_law.report.loop
    assert 0.9 <= loop.seconds <= 1.1 + loop.lateness.worst  # its last frame may be late
    assert not is_alive(by_law.loop_pid)


def test_session_frames_and_misses_equal_deadlines(by_law: Played) -> None:
    loop = by_law.report.loop
    assert loop.frames + loop.missed == pytest.approx(RATE * loop.seconds, abs=2.0)
    assert loop.rate <= RATE * 1.01


def test_session_recording_has_every_frame(by_law: Played) -> None:
    report, frames = by_law.report, by_law.frames
    assert len(frames) == report.loop.frames == report.recorded_frames
    assert report.lost_records == 0
    np.testing.assert_allclose(np.diff(frames["time"]), frames["dt"][1:], atol=1e-9)
    assert (np.diff(frames["time"]) > 0.0).all()


def test_session_report_equals_frames(played: Played) -> None:
    report, frames = played.report, played.frames
    assert report.hit_frames == np.count_nonzero(frames["hits"]) > 0
    assert report.contact_frames == np.count_nonzero(frames["contacts"])
    assert report.unknown_frames == np.count_nonzero(frames["unknown"])
    assert report.held_frames == np.count_nonzero(frames["state"] & State.HELD)
    assert report.loop.lateness.worst == pytest.approx(frames["lateness"].max(), rel=1e-6)
    forces = np.linalg.norm(frames["applied"][:, :3], axis=1)
    assert report.peak_force == pytest.approx(forces.max())
    assert report.objects == (1,)
    assert report.stale_frames == report.cache.losses == 0
    is_free = frames["hits"] == 0
    assert is_free.any()
    assert not frames["applied"][is_free].any()


def test_session_report_finite_json(by_law: Played) -> None:
    found = json.loads(json.dumps(plain(by_law.report), allow_nan=False))
    assert found["loop"]["frames"] == by_law.report.loop.frames
    assert found["loop"]["lateness"]["p99"] == by_law.report.loop.lateness.p99
    assert by_law.report.empty is not None
    assert found["empty"]["frames"] == by_law.report.empty.frames > 0
    assert found["cache"]["budget_bytes"] <= 4 << 20


# -- sessions with disturbances ----------------------------------------------------------------


def test_session_wait_in_steps_and_stop(cells: ResidentCells, sphere: PointShell) -> None:
    with Session(
        cells, sphere, still(0.010), law="plane", rate=RATE, staleness=NEVER_STALE
    ) as session:
        until(lambda: session.n_frames > 100, session)
        last = session.last()
        assert last is not None
        assert last["hits"][0] > 0
        until(lambda: session.objects == (1,), session)
        report = session.stop()
        assert report.loop.frames >= 100
        assert session.wait(TIMEOUT) == session.stop()  # the same report again
    for closed in (session.stop, session.wait, session.last):
        with pytest.raises(UsageError, match="the session is closed"):
            closed()


@pytest.mark.parametrize(
    "how", [signal.SIGTERM, pytest.param(signal.SIGKILL, marks=pytest.mark.long)]
)
def test_session_killed_loop_one_error(
    cells: ResidentCells, sphere: PointShell, tmp_path: Path, how: int
) -> None:
    path = tmp_path / "cut.hdbrec"
    with Session(cells, sphere, still(0.010), law="plane", rate=RATE, record=path) as session:
        until(lambda: session.n_frames > 50, session)
        os.kill(session.pid, how)
        with pytest.raises(HapticDBError, match="ended from outside") as raised:
            session.wait(TIMEOUT)
    assert "\n" not in str(raised.value)
    assert len(recorded(path)) > 50
    with Session(
        cells, sphere, still(0.010), law="plane", rate=RATE, seconds=0.1, staleness=NEVER_STALE
    ) as session:
        report = session.wait(TIMEOUT)  # the cells are still usable
    assert report is not None
    assert report.hit_frames == report.loop.frames


def test_session_close_without_wait_records_all(
    cells: ResidentCells, sphere: PointShell, tmp_path: Path
) -> None:
    path = tmp_path / "unwatched.hdbrec"
    with Session(cells, sphere, still(0.010), law="plane", rate=50.0, record=path) as session:
        until(lambda: len(Recording(path)) > 10, session)  # frames reach the file at once
        n_frames = session.n_frames
    assert len(recorded(path)) >= n_frames


@pytest.mark.parametrize(
    ("kind", "message"),
    [(DeviceError, r"^the hand was unplugged"), (ValueError, r"ended: ValueError: the hand was")],
)
def test_session_failing_hand_raises_its_error(
    cells: ResidentCells, sphere: PointShell, kind: type[Exception], message: str
) -> None:
    hand = Unplugged(still(0.010), 200, kind)
    with Session(cells, sphere, hand, law="plane", rate=RATE) as session:
        with pytest.raises(HapticDBError, match=message):
            session.wait(TIMEOUT)
        pid = session.pid
    assert not is_alive(pid)


def test_session_failed_start_leaves_no_recording(
    cells: ResidentCells, sphere: PointShell, tmp_path: Path
) -> None:
    path = tmp_path / "never.hdbrec"
    hand = Unplugged(still(0.010), 1)
    for _ in range(2):
        with pytest.raises(DeviceError, match="unplugged"):
            Session(cells, sphere, hand, law="plane", record=path)
        assert not path.exists()
    path.write_text("mine")
    with pytest.raises(UsageError, match="is there already"):
        Session(cells, sphere, still(0.010), law="plane", record=path)
    assert path.read_text() == "mine"
    assert not cells.table.queue.pids.any()


@pytest.mark.parametrize("step", ["open", "begin"])
def test_session_terminated_start_leaves_no_recording(
    cells: ResidentCells,
    sphere: PointShell,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    step: str,
) -> None:
    path = tmp_path / "never.hdbrec"
    mine = write(tmp_path / "mine.hdbrec", motion(5))
    before = mine.read_bytes()
    whole = getattr(Recorder, step)

    def ended(recorder: Recorder, *header: Header) -> None:
        whole(recorder, *header)
        raise SystemExit(143)

    monkeypatch.setattr(Recorder, step, ended)
    with pytest.raises(SystemExit):
        Session(cells, sphere, still(0.010), law="plane", record=path)
    assert not path.exists()
    with pytest.raises(SystemExit):
        Session(cells, sphere, still(0.010), law="plane", record=mine, replace_recording=True)
    assert mine.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 0.0}, "a rate of 0.0 Hz"),
        ({"rate": math.nan}, "a rate of nan Hz"),
        ({"seconds": 0.0}, "0.0 seconds"),
        ({"seconds": math.inf}, "inf seconds"),
        ({"processor": -1}, "processor -1 is not granted"),
        ({"staleness": 0.0}, "a staleness of 0.0 s"),
    ],
)
def test_session_bad_options(
    cells: ResidentCells, sphere: PointShell, options: dict[str, object], message: str
) -> None:
    with pytest.raises(UsageError, match=re.escape(message)):
        Session(cells, sphere, still(0.01), law="plane", **options)  # type: ignore[arg-type]


# -- processes that are killed -----------------------------------------------------------------


@pytest.mark.long
def test_session_users_law_with_array_field(cells: ResidentCells, sphere: PointShell) -> None:
    """A wrong address would end the session's process."""
    with Session(
        cells, sphere, still(0.010), law=users_law.Table(), rendering="direct", rate=RATE,
        seconds=0.2, has_baseline=False,
    ) as session:  # fmt: skip
        report = session.wait(TIMEOUT)
    assert report is not None
    assert report.contact_frames == report.loop.frames > 0


def test_layout_of_equals_compiler() -> None:
    layout = _layout_of(typeof(users_law.Table.for_kernels))
    assert [layout.fields[name][1] for name in layout.names] == [0, 8, 16]
    assert layout.itemsize == 72
