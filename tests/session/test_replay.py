"""A replay runs the session's kernel over the recorded hand: the same bits, or a frame and why."""

from collections.abc import Iterator
from dataclasses import replace as changed
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from banded import write_points
from children import TIMEOUT
from hapticdb import Coupling, Environment, Grid, Handle, PointShell
from hapticdb.devices.protocol import Device
from hapticdb.devices.scripted import Player
from hapticdb.errors import GridError
from hapticdb.query.law import LawName
from hapticdb.recording.file import Frames, Recorder, Recording, State
from hapticdb.recording.header import Header
from hapticdb.session.coupling import Rendering
from hapticdb.session.replay import Parting, replay
from hapticdb.session.session import Session
from servers import FOUND, named, url_on
from session.hands import NotedClutched, Steady, at
from session.sessions import NEVER_STALE, RATE, floor_points, recorded, standing_plate
from session.worlds import SIZE, block, make
from voxels import write_voxels

SESSIONS: tuple[tuple[LawName, Rendering], ...] = (
    ("distance", "coupled"), ("distance", "direct"), ("plane", "direct"),
)  # fmt: skip
GRID = Grid(SIZE, (-32 * SIZE,) * 3, 6)


def sliding(low: float) -> Player:
    """A hand that comes down to a height, slides, tilts, and leaves, in a second."""
    tilted = at(-0.02, 0.0, low)
    tilted[1:3, 1:3] = [[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]]
    poses = [at(0.0, 0.0, 0.03), at(0.0, 0.0, low), at(0.02, 0.0, low), tilted, at(0.0, 0.0, 0.03)]
    return Player(np.linspace(0.0, 1.0, len(poses)), poses, clock=Steady())


def record(
    env: Environment, shell: PointShell, path: Path, hand: Device | None = None,
    law: LawName = "distance", rendering: Rendering | None = None, **options: object,
) -> Frames:  # fmt: skip
    """Record a session and return its frames."""
    with Session(
        env.url, shell, hand or sliding(0.010), law=law, rendering=rendering, rate=RATE,
        record=path, staleness=NEVER_STALE, has_baseline=False, **options,  # type: ignore[arg-type]
    ) as session:  # fmt: skip
        assert session.wait(TIMEOUT) is not None
    frames = recorded(path)
    assert frames["contacts"].any()
    return frames


def parting(path: Path, env: Environment) -> Parting:
    found = replay(Recording(path), env).parting
    assert found is not None
    return found


@pytest.fixture(scope="module", params=[None, *FOUND], ids=named)
def env(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Environment]:
    """A floor with distances, on each engine."""
    with (
        url_on(request.param, tmp_path_factory.mktemp("replay")) as url,
        hapticdb.create(url, GRID) as made,
    ):
        write_points(made.store, floor_points(31.5), "floor")
        yield made


@pytest.mark.parametrize(("law", "rendering"), SESSIONS)
def test_replay_same_bits_as_device_received(
    env: Environment, sphere: PointShell, tmp_path: Path, law: LawName, rendering: Rendering
) -> None:
    hand = NotedClutched(sliding(0.004), tmp_path / "received")
    handle = Handle(clutch=0)
    frames = record(env, sphere, tmp_path / "s.hdbrec", hand, law, rendering, handle=handle)
    received = np.fromfile(hand.path).reshape(-1, 6)
    # before the first frame and after the last one the device is set to zero
    assert received[1 : 1 + len(frames)].tobytes() == frames["applied"].tobytes()
    assert not received[0].any()
    assert not received[1 + len(frames) :].any()
    assert frames["applied"].any()
    assert (frames["state"] & State.CLUTCH_OPEN > 0).any()
    found = replay(Recording(tmp_path / "s.hdbrec"), env)
    assert found.is_equal, found.describe()
    assert found.n_frames == len(frames)
    assert found.describe().startswith(f"equal: {len(frames):,} frames at revision 1,")


@pytest.fixture(scope="module")
def session(
    distance_floor: Environment, sphere: PointShell, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    path = tmp_path_factory.mktemp("session") / "s.hdbrec"
    record(distance_floor, sphere, path)
    return path


def rewritten(path: Path, frames: Frames, header: Header | None = None) -> Path:
    """A recording beside another one, with other frames or another header."""
    made = path.with_name("changed.hdbrec")
    made.unlink(missing_ok=True)
    with Recorder(made) as recorder:
        recorder.open()
        recorder.begin(header or Recording(path).header)
        recorder.append(frames)
    return made


@pytest.mark.parametrize("field", ["tool", "applied", "contacts", "hand"])
def test_replay_changed_bit_named_by_frame(
    distance_floor: Environment, session: Path, field: str
) -> None:
    frames = recorded(session)
    n = int(np.flatnonzero(frames["contacts"])[40])
    frames[field].reshape(len(frames), -1)[n].view(np.uint8)[1] ^= 1
    found = parting(rewritten(session, frames), distance_floor)
    assert (found.frame, found.time) == (n, frames["time"][n])
    assert found.reason == "for no known reason"
    assert found.describe().startswith(f"parts at frame {n} ({found.time:.3f} s), for no known")


def test_replay_reasons_lost_frames_build_gpu(distance_floor: Environment, session: Path) -> None:
    frames, header = recorded(session), Recording(session).header
    n = int(np.flatnonzero(frames["contacts"])[40])
    found = parting(rewritten(session, np.delete(frames, np.s_[n - 20 : n])), distance_floor)
    assert found.frame >= n - 20
    assert found.reason == f"since frames before frame {n - 20} were lost"
    frames["applied"][n] += 1.0
    for other, words in (
        (changed(header, build="other"), "another build"),
        (changed(header, frames_on="cuda"), "a GPU"),
    ):
        found = parting(rewritten(session, frames, other), distance_floor)
        assert found.frame == n
        assert words in found.reason


def test_replay_edit_named_only_in_reach(tmp_path: Path, sphere: PointShell) -> None:
    with make(tmp_path, bits=6) as env:
        write_points(env.store, floor_points(31.5), "floor")
        write_points(env.store, np.array([[2.0, 2.0, 2.0]]), "aside")
        frames = record(env, sphere, tmp_path / "s.hdbrec")
        env.remove(2)
        found = replay(Recording(tmp_path / "s.hdbrec"), env)
        assert (found.is_equal, found.revision) == (True, env.store.revision())
        env.remove(1)
        first = parting(tmp_path / "s.hdbrec", env)
    assert frames["hits"][: first.frame].max(initial=0) == 0
    assert first.reason.startswith("since the environment was edited: revision 2 then, 4 now")


def test_replay_unknown_cells_named(tmp_path: Path, sphere: PointShell) -> None:
    """A hand that leaps over the floor meets cells that nobody has fetched yet."""
    far = [at(x, 0.0, z) for x, z in ((-0.4, 0.03), (-0.4, 0.01), (0.4, 0.01), (0.4, 0.03))]
    hand = Player([0.0, 0.3, 0.301, 0.7], far)
    with make(tmp_path, bits=9) as env:
        write_voxels(env.store, block((0, 240, 248), (511, 271, 255)), "floor, 1 m long")
        frames = record(env, sphere, tmp_path / "s.hdbrec", hand, "plane")
        n = int(np.flatnonzero(frames["unknown"])[0])
        found = parting(tmp_path / "s.hdbrec", env)
    assert found.frame >= n > 50
    assert found.reason == f"since frame {n} met cells not in memory"


def test_replay_large_tool_filter_coupling_same_bits(
    distance_floor: Environment, tmp_path: Path
) -> None:
    coupling = Coupling(stiffness=700.0, cap=2.0)
    path = tmp_path / "s.hdbrec"
    cells = hapticdb.ResidentCells(distance_floor.url, where=["floor"])
    with cells, Session(
        cells, standing_plate(), sliding(-0.001), rate=RATE, record=path, staleness=NEVER_STALE,
        coupling=coupling, has_baseline=False,
    ) as session:  # fmt: skip
        assert session.wait(TIMEOUT) is not None
    frames = recorded(path)
    assert frames["contacts"].any()
    assert (frames["spring"][:, 2] == 2.0).all()
    added = write_points(distance_floor.store, floor_points(33.5), "another floor")
    try:
        found = replay(Recording(path), distance_floor)
    finally:
        distance_floor.remove(added)
    assert found.is_equal, found.describe()


def test_replay_other_grid_and_empty_recording(
    tmp_path: Path, distance_floor: Environment, session: Path
) -> None:
    with make(tmp_path, bits=7) as other, pytest.raises(GridError, match="was recorded on"):
        replay(Recording(session), other)
    found = replay(Recording(rewritten(session, recorded(session)[:0])), distance_floor)
    assert (found.is_equal, found.n_frames) == (False, 0)
    assert found.describe() == "nothing to compare: the recording has no frames"
