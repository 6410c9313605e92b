"""A batch tool keeps cells from call to call, and feels the newest revision at each call."""

from pathlib import Path

import pytest

import hapticdb
from hapticdb.errors import ConnectionLostError, ObjectNotFoundError, UsageError
from hapticdb.resident.residency import Residency
from hapticdb.store.base import Keys
from session.worlds import SIZE, block, cloud, make, move, poses_in, scatter
from voxels import write_voxels


def test_batch_tool_reuses_cells_until_closed(tmp_path: Path) -> None:
    with make(tmp_path) as env:
        scatter(env)
        shell, poses = cloud(100), poses_in(env.grid, 50)
        with env.batch_tool(shell, jobs=2) as batch_tool:
            first = batch_tool.touch(poses)
            n_loaded = batch_tool.n_loaded
            assert n_loaded > 0
            again = batch_tool.touch(poses[::-1])
            assert batch_tool.n_loaded == n_loaded
        assert again.forces[::-1].tobytes() == first.forces.tobytes()
        batch_tool.close()
        for ask in (batch_tool.touch, batch_tool.clearance, batch_tool.collides):
            with pytest.raises(UsageError, match="closed"):
                ask(poses)


@pytest.mark.parametrize("by", ["itself", "another"])
def test_batch_tool_sees_edits_between_calls(tmp_path: Path, by: str) -> None:
    with make(tmp_path) as env:
        write_voxels(env.store, block((0, 0, 0), (127, 127, 60)), "floor")
        shell, poses = cloud(100, extent=0.01), poses_in(env.grid, 30, beyond=0.0)
        with env.batch_tool(shell) as batch_tool:
            before, far = batch_tool.touch(poses), batch_tool.clearance(poses)
            assert far.revision == before.revision
            other = env if by == "itself" else hapticdb.open(env.url)
            move(other.store, 1, block((0, 0, 70), (127, 127, 127)))
            if other is not env:
                other.close()
            after, near = batch_tool.touch(poses), batch_tool.clearance(poses)
            assert batch_tool.collides(poses).tolist() == (after.hits > 0).tolist()
        assert after.revision > before.revision
        assert near.revision == after.revision
        assert (after.forces != before.forces).any()
        assert after.forces.tobytes() == env.touch(shell, poses=poses).forces.tobytes()
        assert (near.distances != far.distances).any()
        assert near.distances == pytest.approx(env.clearance(shell, poses).distances, abs=1e-12)


def test_batch_tool_resolves_words_after_edit(tmp_path: Path) -> None:
    with make(tmp_path, 6) as env:
        write_voxels(env.store, block((0, 0, 0), (63, 63, 31)), "floor")
        shell, poses = cloud(20, extent=0.01), poses_in(env.grid, 5, beyond=0.0)
        with env.batch_tool(shell, exclude=["lid*"]) as batch_tool:
            with pytest.raises(ObjectNotFoundError, match=r"lid\*"):
                batch_tool.touch(poses)
            write_voxels(env.store, block((0, 0, 32), (63, 63, 63)), "lid 1")
            felt = batch_tool.touch(poses, objects=True)
            assert [obj.name for obj in felt.objects] == ["floor"]


def test_batch_tool_reconnects_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with make(tmp_path) as env:
        scatter(env)
        shell, poses = cloud(100), poses_in(env.grid, 50)
        expected = env.touch(shell, poses=poses)
        real = Residency.make_resident
        lost: list[Keys] = []

        def lose_once(self: Residency, cells: Keys) -> None:
            real(self, cells)
            if not lost:
                lost.append(cells)
                raise ConnectionLostError("the server went away: try again")

        monkeypatch.setattr(Residency, "make_resident", lose_once)
        felt = env.touch(shell, poses=poses)
        assert lost
        assert felt.forces.tobytes() == expected.forces.tobytes()


@pytest.mark.parametrize("jobs", [1, 3])
def test_batch_tool_usable_after_interrupt(tmp_path: Path, jobs: int) -> None:
    with make(tmp_path) as env:
        scatter(env)
        shell, poses = cloud(100), poses_in(env.grid, 50)

        def interrupt(_done: int, _total: int) -> None:
            raise KeyboardInterrupt

        with env.batch_tool(shell, jobs=jobs) as batch_tool:
            with pytest.raises(KeyboardInterrupt):
                batch_tool.touch(poses, progress=interrupt)
            again = batch_tool.touch(poses)
            far = batch_tool.clearance(poses, 5 * SIZE)
        assert again.forces.tobytes() == env.touch(shell, poses=poses).forces.tobytes()
        assert (far.distances[again.hits > 0] == 0.0).all()
        assert (far.distances[again.hits == 0] > 0.0).all()
