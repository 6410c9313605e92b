"""A replay equals its session bit for bit, or differs from the first frame that feels an edit."""

from pathlib import Path

import numpy as np
import pytest

import hapticdb
from hapticdb import Environment, Grid, PointShell, TangentPlane
from hapticdb.errors import GridError
from hapticdb.kernels.rigid import poses_of
from hapticdb.recording.file import FRAME, Frames, Header, Recorder, Recording, State
from hapticdb.recording.replay import replay, touching
from hapticdb.testing import blob, floor_voxels, write_voxels

GRID = Grid(0.005, (0.0, 0.0, 0.0), 6)
LAW = TangentPlane(650.0)
N = 60


@pytest.fixture
def env(tmp_path: Path) -> Environment:
    """An environment: a floor, and a block that the tool never reaches."""
    env = hapticdb.create(tmp_path / "e.db", GRID)
    write_voxels(env.store, floor_voxels(GRID), "floor")
    write_voxels(env.store, blob(1, (60, 60, 60), 2), "aside")
    return env


def felt(env: Environment, shell: PointShell, exclude: tuple[int, ...] = ()) -> Frames:
    """Frames of a tool that sinks into the floor, turns, and slides along."""
    s = np.linspace(0.0, 1.0, N)
    frames = np.zeros(N, dtype=FRAME)
    frames["time"] = s
    frames["tool"][:, :3] = np.stack([0.1 + 0.12 * s, 0.15 + 0 * s, 0.19 - 0.03 * s], axis=1)
    axis = np.array([0.6, 0.0, 0.8])
    frames["tool"][:, 3] = np.cos(s)
    frames["tool"][:, 4:] = np.sin(s)[:, None] * axis
    poses = np.empty((N, 4, 4))
    poses_of(np.ascontiguousarray(frames["tool"]), poses)
    frames["wrench"], frames["hits"] = touching(env, shell, LAW, exclude)(poses)
    frames["revision"] = env.store.revision()
    assert 0 < np.count_nonzero(frames["hits"]) < N
    return frames


def record(
    path: Path, env: Environment, shell: PointShell, frames: Frames, exclude: tuple[int, ...] = ()
) -> Recording:
    """Record frames in chunks of 25."""
    header = Header(
        env.url, env.grid, env.store.revision(), shell, 1000.0, law=LAW, exclude=exclude
    )
    with Recorder(path, header) as recorder:
        for start in range(0, len(frames), 25):
            recorder.append(frames[start : start + 25])
            recorder.flush()
    return Recording(path)


@pytest.fixture
def session(tmp_path: Path, env: Environment, sphere: PointShell) -> Recording:
    return record(tmp_path / "s.hdbrec", env, sphere, felt(env, sphere))


def test_the_same_revision_gives_the_same_bits(env: Environment, session: Recording) -> None:
    found = replay(session, env)
    assert found.is_equal
    assert found.is_same_revision
    assert (found.n_compared, found.n_skipped, found.n_differing) == (N, 0, 0)
    assert (
        found.describe() == "equal: 60 frames at the same revision 2, 0 skipped (unknown or held)"
    )


def test_a_filter_is_replayed_as_it_was_felt(
    tmp_path: Path, env: Environment, sphere: PointShell
) -> None:
    """Also after others have added what the words do not choose, and removed what they chose."""
    words = ["floor", "aside"]
    frames = felt(env, sphere)
    header = Header(env.url, env.grid, env.store.revision(), sphere, 1000.0, law=LAW, where=words)
    with Recorder(tmp_path / "w.hdbrec", header) as recorder:
        recorder.append(frames)
    found = replay(Recording(tmp_path / "w.hdbrec"), env)
    assert (found.is_equal, found.is_same_revision) == (True, True)
    write_voxels(
        env.store, floor_voxels(GRID, depth=12, width=48) + np.array([0, 0, 4]), "another floor"
    )
    env.remove(env.find("aside")[0].id)
    recording = Recording(tmp_path / "w.hdbrec")
    assert replay(recording, env).is_equal
    poses = np.empty((N, 4, 4))
    poses_of(np.ascontiguousarray(frames["tool"]), poses)
    assert (touching(env, sphere, LAW, where=words)(poses)[1] == frames["hits"]).all()
    assert (touching(env, sphere, LAW)(poses)[1] != frames["hits"]).any()


def test_an_environment_without_cells_is_replayed_by_touches(
    tmp_path: Path, sphere: PointShell
) -> None:
    grid = Grid(0.005, (0.0, 0.0, 0.0), 6, "lexicographic")
    with hapticdb.create(tmp_path / "lexicographic.db", grid, layout="voxel") as env:
        write_voxels(env.store, floor_voxels(grid), "floor")
        assert replay(record(tmp_path / "l.hdbrec", env, sphere, felt(env, sphere)), env).is_equal


def test_a_recording_without_frames_is_not_equal(
    tmp_path: Path, env: Environment, sphere: PointShell
) -> None:
    frames = felt(env, sphere)[:0]
    found = replay(record(tmp_path / "empty.hdbrec", env, sphere, frames), env)
    assert (found.n_compared, found.n_skipped, found.is_equal) == (0, 0, False)
    assert found.describe() == "nothing to compare: 0 skipped (unknown or held)"


def test_an_edit_elsewhere_is_not_felt(env: Environment, session: Recording) -> None:
    env.remove(2)
    found = replay(session, env)
    assert (found.is_equal, found.is_same_revision, found.revision) == (True, False, 3)
    assert found.describe().startswith("equal: 60 frames at another revision, now 3")


def test_frames_part_where_an_edit_is_first_felt(
    env: Environment, sphere: PointShell, session: Recording
) -> None:
    """Edits: a new wall that the tool reaches on its way, and the removal of the floor."""
    before = np.concatenate([frames["hits"] for frames in session.frames()])
    i, j, k = np.meshgrid(np.arange(38, 42), np.arange(64), np.arange(64), indexing="ij")
    wall = write_voxels(env.store, np.stack([i, j, k], axis=-1).reshape(-1, 3), "wall")
    now = felt(env, sphere)
    wanted = int(np.argmax(now["hits"] != before))
    assert 25 < wanted < N
    found = replay(session, env)
    assert found.parting is not None
    assert not found.is_equal
    assert (found.parting.frame, found.parting.time) == (wanted, now["time"][wanted])
    assert (found.parting.revision_recorded, found.parting.revision_present) == (2, 3)
    assert found.parting.hits_present == now["hits"][wanted]
    np.testing.assert_array_equal(found.parting.present, now["wrench"][wanted])
    np.testing.assert_array_equal(found.parting.recorded, session.columns("wrench")[0][wanted])
    assert found.describe().startswith(f"parts at frame {wanted} (")

    env.remove(wall)
    assert replay(session, env).is_equal
    env.remove(1)
    gone = replay(session, env)
    assert gone.parting is not None
    assert gone.parting.frame == int(np.argmax(before > 0))
    assert gone.n_differing == np.count_nonzero(before)


def test_frames_that_were_unknown_or_held_are_skipped(
    tmp_path: Path, env: Environment, sphere: PointShell
) -> None:
    frames = felt(env, sphere)
    frames["unknown"][10:14] = 3
    frames["state"][30] = State.HELD | State.CLUTCH_OPEN
    frames["state"][31] = State.CLUTCH_OPEN
    for n in (10, 13, 30):
        frames["wrench"][n] = 77.0
    session = record(tmp_path / "s.hdbrec", env, sphere, frames)
    found = replay(session, env)
    assert (found.is_equal, found.n_compared, found.n_skipped) == (True, N - 5, 5)
    frames["unknown"] = 1
    found = replay(record(tmp_path / "none.hdbrec", env, sphere, frames), env)
    assert found.describe() == "nothing to compare: 60 skipped (unknown or held)"
    assert not found.is_equal


@pytest.mark.parametrize("column", ["wrench", "hits"])
def test_the_last_bit_counts(
    tmp_path: Path, env: Environment, sphere: PointShell, column: str
) -> None:
    frames = felt(env, sphere)
    if column == "wrench":
        frames["wrench"][51, 2] = np.nextafter(frames["wrench"][51, 2], 1e9)
    else:
        frames["hits"][51] += 1
    found = replay(record(tmp_path / "s.hdbrec", env, sphere, frames), env)
    assert found.parting is not None
    assert (found.parting.frame, found.n_differing) == (51, 1)


def test_what_was_not_felt_is_not_felt_again(
    tmp_path: Path, env: Environment, sphere: PointShell
) -> None:
    """An object that the session left out stays left out, also when it has been removed."""
    through = write_voxels(env.store, floor_voxels(GRID, depth=3), "through")
    session = record(tmp_path / "s.hdbrec", env, sphere, felt(env, sphere, (through,)), (through,))
    assert replay(session, env).is_equal
    env.remove(through)
    assert replay(session, env).is_equal


def test_another_grid_is_refused(tmp_path: Path, session: Recording) -> None:
    with (
        hapticdb.create(tmp_path / "o.db", Grid(0.005, (0.0, 0.0, 0.1), 6)) as other,
        pytest.raises(GridError, match="was recorded on 64\\^3 voxels of 5 mm"),
    ):
        replay(session, other)


def test_frames_before_damage_can_be_replayed(env: Environment, session: Recording) -> None:
    content = bytearray(session.path.read_bytes())
    content[-200] ^= 1
    session.path.write_bytes(content)
    damaged = Recording(session.path)
    with pytest.raises(hapticdb.errors.FileError, match="damaged at frame 50"):
        replay(damaged, env)
    assert replay(damaged, env, until_damage=True).n_compared == 50
