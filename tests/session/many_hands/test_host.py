"""Hosted sessions: many hands in worker processes, over shared tables of cells."""

import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import hapticdb
from banded import write_points
from children import child, until
from hapticdb import Environment, PointShell
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.poses import row_of_pose
from hapticdb.recording.file import Recording
from hapticdb.recording.frame import State
from hapticdb.resident.table import is_alive
from hapticdb.session import host as module
from hapticdb.session.attached import AttachedHost
from hapticdb.session.coupling import Coupling, Rendering
from hapticdb.session.host import SessionHost
from hapticdb.session.hosted import HostedSession
from hapticdb.session.replay import replay
from session.hands import at
from session.sessions import recorded, standing_plate

Floats = NDArray[np.float64]
RATE = 500.0
"""Frames a second of the tests' sessions."""
ABOVE, PRESSED = at(0.0, 0.0, 0.02), at(0.0, 0.0, 0.004)
"""Poses of the ball of 12 mm: over the floor at z = 0, and pressed into it."""


@pytest.fixture(scope="module")
def host(distance_floor: Environment) -> Iterator[SessionHost]:
    with SessionHost(distance_floor.url, rate=RATE, budget_bytes=8 << 20, processes=2) as made:
        yield made


@pytest.fixture
def session(host: SessionHost, sphere: PointShell) -> Iterator[HostedSession]:
    begun = host.begin(sphere, ABOVE)
    until(lambda: begun.latest() is not None)
    yield begun
    begun.end()


def pushed(session: HostedSession) -> float:
    """Force along z that the hand feels now, N."""
    last = session.latest()
    return 0.0 if last is None else float(last["applied"][0, 2])


def force_of(session: HostedSession) -> float:
    """Size of the force that the hand feels now, N."""
    last = session.latest()
    return 0.0 if last is None else float(np.linalg.norm(last["applied"][0, :3]))


def press(
    sessions: Sequence[HostedSession], claim: Callable[[], object], pose: Floats = PRESSED
) -> None:
    """Hold the tools at a pose, as browsers do, until a claim is true."""

    def is_true() -> object:
        for session in sessions:
            session.move(pose)
        return claim()

    until(is_true, every=0.02)


def run_frames(session: HostedSession, count: int) -> None:
    """Wait until the session has run so many frames more."""
    before = session.figures().frames
    until(lambda: session.figures().frames >= before + count)


def test_host_floor_force_and_touched_objects(
    session: HostedSession, distance_floor: Environment
) -> None:
    (floor,) = distance_floor.find("floor")
    assert (pushed(session), session.touched()) == (0.0, ())
    press([session], lambda: pushed(session) > 0.5 and session.touched() == (floor.id,))
    press([session], lambda: pushed(session) == 0.0 and session.touched() == (), ABOVE)


def _height(session: HostedSession) -> float:
    last = session.latest()
    assert last is not None
    return float(last["hand"][0, 2])


def test_host_contacts_on_floor(session: HostedSession) -> None:
    press([session], lambda: pushed(session) > 0.5 and len(session.contacts()[0]))
    points, forces = session.contacts()
    assert points.shape == forces.shape
    assert (np.abs(points[:, 2]) < 0.006).all()
    assert forces[:, 2].sum() > 0.0


def test_host_recording_replays_same_bits(
    session: HostedSession, distance_floor: Environment, tmp_path: Path
) -> None:
    press([session], lambda: pushed(session) > 0.5)
    path = tmp_path / "hosted.hdbrec"
    session.record(path)
    with pytest.raises(UsageError, match="recorded already"):
        session.record(tmp_path / "second.hdbrec")
    for n, z in enumerate(np.linspace(0.004, 0.0, 20)):
        session.move(row_of_pose(at(0.001, 0.0, z)))
        run_frames(session, 10)
        if n == 10:
            session.set_coupling(Coupling(stiffness=300.0))
    n_frames = session.stop_recording()
    frames = recorded(path)
    assert len(frames) == n_frames > 100
    assert frames["time"][0] == 0.0
    assert frames["contacts"].max() > 0
    assert sorted(set(frames["spring"][:, 0])) == [300.0, 1000.0]
    assert not frames["state"][0] & State.ANEW  # the state of the running session was taken over
    result = replay(Recording(path), distance_floor)
    assert result.is_equal, result.describe()


def test_host_excluded_objects(
    host: SessionHost, sphere: PointShell, session: HostedSession
) -> None:
    without = host.begin(sphere, ABOVE, exclude=["floor"])
    try:
        assert len(host.cells) == 2
        press([session, without], lambda: pushed(session) > 0.5)
        assert pushed(without) == 0.0
    finally:
        without.end()
    assert len(host.cells) == 1


def test_host_cell_edited_beside_resting_tool(
    host: SessionHost, distance_floor: Environment
) -> None:
    """The tool rests above the floor, and something is put where it is."""
    session = host.begin(standing_plate(), ABOVE)
    until(lambda: session.figures().frames > 20)
    last = session.latest()
    assert last is not None
    assert last["hits"][0] == 0
    points = np.array([(x, 32.0, 47.0) for x in np.arange(30.0, 34.0, 0.25)])
    added = write_points(distance_floor.store, points, "put")
    try:
        until(lambda: (f := session.latest()) is not None and f["state"][0] & State.IN_OBJECT)
    finally:
        session.end()
        distance_floor.remove(added)


@pytest.mark.parametrize(
    "pose",
    [np.zeros((4, 4)), np.full((4, 4), np.nan), at(2e9, 0.0, 0.0), np.ones(7), np.full(7, np.nan)],
)
def test_hosted_session_bad_pose(session: HostedSession, pose: Floats) -> None:
    with pytest.raises(UsageError):
        session.move(pose)


def test_host_survey_coordinates(tmp_path: Path, sphere: PointShell) -> None:
    where = np.array([515_369.0, 4_918_340.0, 2_322.0])
    box = trimesh.creation.box((0.2, 0.2, 0.1))
    box.vertices += where - (0.0, 0.0, 0.05)  # its top is at `where`
    (tmp_path / "box.obj").write_text(trimesh.exchange.obj.export_obj(box, digits=9))
    hapticdb.import_files(tmp_path / "far.db", [tmp_path / "box.obj"])
    with SessionHost(str(tmp_path / "far.db"), rate=RATE, budget_bytes=8 << 20) as host:
        x, y, z = where
        session = host.begin(sphere, at(x, y, z + 0.02))
        press([session], lambda: pushed(session) > 0.5, at(x, y, z + 0.004))
        session.end()


def test_hosted_session_ended(host: SessionHost, sphere: PointShell) -> None:
    session = host.begin(sphere, ABOVE)
    session.end()
    session.end()
    assert session.is_over
    for use in (lambda: session.move(ABOVE), session.latest, session.figures):
        with pytest.raises(UsageError, match="is over"):
            use()


@pytest.mark.parametrize(
    ("floor", "rendering"), [("voxel_floor", None), ("distance_floor", "direct")]
)
def test_host_direct_rendering_frame_wrench(
    floor: str, rendering: Rendering | None, request: pytest.FixtureRequest, sphere: PointShell,
    tmp_path: Path,
) -> None:  # fmt: skip
    env: Environment = request.getfixturevalue(floor)
    with SessionHost(env.url, rate=RATE, budget_bytes=8 << 20, rendering=rendering) as host:
        session = host.begin(sphere, ABOVE)
        press([session], lambda: pushed(session) > 0.5 and session.touched() == (1,))
        session.record(tmp_path / "direct.hdbrec")
        session.set_coupling(Coupling(cap=0.25))
        press([session], lambda: force_of(session) == pytest.approx(0.25))
        with pytest.raises(UsageError, match="stiffness does not go with the rendering direct"):
            session.set_coupling(Coupling(stiffness=100.0))
        session.end()
    frames = recorded(tmp_path / "direct.hdbrec")
    assert (frames["tool"] == frames["hand"]).all()
    result = replay(Recording(tmp_path / "direct.hdbrec"), env)
    assert result.is_equal, result.describe()


def test_host_coupling_needs_distances(voxel_floor: Environment, sphere: PointShell) -> None:
    with (
        SessionHost(voxel_floor.url, rate=RATE, rendering="coupled") as host,
        pytest.raises(UsageError, match=r"import with distances .* leave out --rendering coupled"),
    ):
        host.begin(sphere, ABOVE)


def test_host_session_limit(
    distance_floor: Environment, sphere: PointShell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_SESSIONS", 1)
    with SessionHost(distance_floor.url, rate=RATE, budget_bytes=8 << 20) as host:
        first = host.begin(sphere, ABOVE)
        with pytest.raises(UsageError, match="end one first"):
            host.begin(sphere, ABOVE)
        first.end()
        host.begin(sphere, ABOVE)


def test_attached_host_sessions_end_on_detach(
    host: SessionHost, session: HostedSession, sphere: PointShell
) -> None:
    ours, theirs = socket.socketpair()
    host.serve(ours)
    attached = AttachedHost(theirs)
    mine = attached.begin(sphere, ABOVE)
    assert {one.id for one in host.sessions()} == {session.id, mine.id}
    press([mine], lambda: pushed(mine) > 0.5)
    with pytest.raises(UsageError, match="scale"):
        attached.begin(sphere, ABOVE, scale=-1.0)
    attached.close()
    mine.end()  # it has ended
    with pytest.raises(UsageError, match="the host was left"):
        attached.begin(sphere, ABOVE)
    until(lambda: [one.id for one in host.sessions()] == [session.id])


CLIENT = """
import socket, time
import numpy as np
from hapticdb import PointShell
from hapticdb.session.attached import AttachedHost
host = AttachedHost(socket.socket(fileno=0))
shell = PointShell(np.array([[0.0, 0.0, -0.005]]), np.array([[0.0, 0.0, 1.0]]), np.zeros(3))
host.begin(shell, np.eye(4))
print("begun", flush=True)
time.sleep(600)
"""


def test_attached_host_sessions_end_with_dead_client(host: SessionHost) -> None:
    ours, theirs = socket.socketpair()
    with theirs, child([sys.executable, "-c", CLIENT], stdin=theirs.fileno(), stderr=None) as other:
        host.serve(ours)
        assert other.stdout is not None
        assert other.stdout.readline() == "begun\n"
        assert host.sessions()
        other.kill()
    until(lambda: not host.sessions())


def test_host_dead_worker_ends_its_sessions(
    distance_floor: Environment, sphere: PointShell
) -> None:
    with SessionHost(distance_floor.url, rate=RATE, budget_bytes=8 << 20) as host:
        session = host.begin(sphere, ABOVE)
        os.kill(host.pids[0], signal.SIGKILL)
        until(lambda: session.is_over)
        with pytest.raises(UsageError, match="is over"):
            session.move(ABOVE)
        session.end()
        another = host.begin(sphere, ABOVE)
        press([another], lambda: pushed(another) > 0.5)


def test_host_close_ends_processes(distance_floor: Environment, sphere: PointShell) -> None:
    host = SessionHost(distance_floor.url, rate=RATE, budget_bytes=8 << 20)
    host.begin(sphere, ABOVE)
    pids = [*host.pids, *(cells.pid for cells in host.cells)]
    host.close()
    host.close()
    assert not any(map(is_alive, pids))
    with pytest.raises(UsageError, match="closed"):
        host.begin(sphere, ABOVE)


def test_host_numbers_out_of_range(distance_floor: Environment) -> None:
    with pytest.raises(UsageError, match="give 10 to"):
        SessionHost(distance_floor.url, rate=5.0)
    with pytest.raises(UsageError, match="give 1 or more"):
        SessionHost(distance_floor.url, processes=0)


def test_attached_host_closed_socket() -> None:
    ours, theirs = socket.socketpair()
    ours.close()
    with pytest.raises(HapticDBError, match="no host"):
        AttachedHost(theirs)


def test_host_64_sessions_share_table(distance_floor: Environment, sphere: PointShell) -> None:
    with SessionHost(distance_floor.url, rate=250.0, budget_bytes=16 << 20, processes=1) as host:
        sessions = [host.begin(sphere, ABOVE) for _ in range(64)]
        assert len(host.cells) == len(host.pids) == 1
        press(sessions, lambda: all(pushed(session) > 0.5 for session in sessions))
        for session in sessions[::2]:
            session.end()
        assert [one.id for one in host.sessions()] == [one.id for one in sessions[1::2]]
        press(sessions[1::2], lambda: all(pushed(session) > 0.5 for session in sessions[1::2]))
        again = [host.begin(sphere, ABOVE) for _ in range(32)]  # their rows are free again
        until(lambda: all(session.latest() is not None for session in again))


def test_host_overload_same_lower_rate(distance_floor: Environment, sphere: PointShell) -> None:
    with SessionHost(distance_floor.url, rate=20_000.0, budget_bytes=16 << 20, processes=1) as host:
        sessions = [host.begin(sphere, PRESSED) for _ in range(24)]

        def share_alike() -> bool:
            """Whether all run as many frames in the same time, unless we were slow to count."""
            before = [session.figures().frames for session in sessions]
            run_frames(sessions[-1], 2000)
            frames = np.array([session.figures().frames for session in sessions]) - before
            return bool(frames.max() - frames.min() < 0.2 * frames.max())

        until(share_alike)
        figures = [session.figures() for session in sessions]
        assert all(one.missed > 0.1 * one.frames for one in figures)


def test_host_silent_database_force_fades(distance_floor: Environment, sphere: PointShell) -> None:
    with SessionHost(distance_floor.url, rate=250.0, budget_bytes=16 << 20) as host:
        session = host.begin(sphere, ABOVE)
        press([session], lambda: pushed(session) > 0.5)
        fetching = host.cells[0].pid
        os.kill(fetching, signal.SIGSTOP)
        try:
            until(lambda: pushed(session) == 0.0)
            last = session.latest()
            assert last is not None
            assert last["state"][0] & State.HELD
            assert session.counts()["stale_frames"] > 0
        finally:
            os.kill(fetching, signal.SIGCONT)
        until(lambda: pushed(session) > 0.5)
