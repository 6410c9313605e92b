"""A batch equals the single touches of its poses, bit for bit, whatever fits into memory."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from banded import write_points
from hapticdb import Environment, Grid, PointShell
from hapticdb import create as create_environment
from hapticdb.batches import batch_threads
from hapticdb.batches.batch_results import TouchBatch
from hapticdb.errors import ObjectNotFoundError, UsageError
from hapticdb.resident.table import LEAST_BUDGET
from session.worlds import HIERARCHICAL, block, cloud, make, poses_in, scatter
from voxels import write_voxels

Floats = NDArray[np.float64]


def assert_equals_touches(
    felt: TouchBatch, env: Environment, shell: PointShell, poses: Floats, exclude: list[int]
) -> None:
    """Each pose's wrench, counts and objects are those of `Environment.touch`."""
    for n, pose in enumerate(poses):
        touch = env.touch(shell, pose, exclude=exclude)
        assert (felt.forces[n] + 0.0).tobytes() == (touch.force + 0.0).tobytes()
        assert (felt.torques[n] + 0.0).tobytes() == (touch.torque + 0.0).tobytes()
        assert felt.hits[n] == len(touch.hits)
        assert felt.n_contacts[n] == len(touch.contacts)
        assert felt.deepest[n] == touch.contact_depths.max(initial=0.0)
        assert felt.ids_at(n) == [obj.id for obj in touch.objects]


@given(st.integers(0, 10_000))
@settings(max_examples=6)
def test_touch_batch_equals_single_touches(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    """In each layout and curve, in and outside the grid, for tools of any size."""
    rng = np.random.default_rng(seed)
    layout, curve = HIERARCHICAL[seed % 4]
    with make(tmp_path_factory.mktemp("batch"), 6, layout, curve) as env:
        scatter(env, n_voxels=1500, seed=seed)
        shell = cloud(int(rng.integers(1, 300)), seed, float(rng.choice([0.002, 0.01, 0.04])))
        poses = poses_in(env.grid, 12, seed)
        for exclude in ([], [2]):
            felt = env.touch(shell, poses=poses, exclude=exclude, objects=True)
            assert_equals_touches(felt, env, shell, poses, exclude)
            collides = env.collides(shell, poses, exclude=exclude)
            assert collides.tolist() == (felt.hits > 0).tolist()


def test_touch_batch_distance_law_equals_single_touches(tmp_path: Path) -> None:
    with create_environment(tmp_path / "s.db", Grid(0.002, (-0.06,) * 3, 6)) as env:
        sheet = np.argwhere(np.ones((40, 40))) / 3.0 - 7.0
        for axis in range(2):
            points = np.insert(sheet, axis, 0.3, axis=1) + 32.0 + 2.0 * axis
            write_points(env.store, points, f"sheet {axis}")
        assert env.has_distances
        shell, poses = cloud(200, extent=0.012), poses_in(env.grid, 16, beyond=-0.35)
        felt = env.touch(shell, poses=poses, objects=True)
        assert felt.law.stiffness == 1000.0
        assert felt.n_contacts.any()
        assert_equals_touches(felt, env, shell, poses, [])
        with env.batch_tool(shell) as batch_tool:  # hits are of voxels, whatever the law
            assert batch_tool.collides(poses).tolist() == (felt.hits > 0).tolist()


def test_touch_batch_threads_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """512 cells, nearly all with voxels, in a table with fewer slots; poses in random order."""
    monkeypatch.setattr(batch_threads, "CHUNK_POSES", 3)
    with make(tmp_path, 8) as env:
        rng = np.random.default_rng(0)
        write_voxels(env.store, np.unique(rng.integers(0, 256, (60_000, 3)), axis=0))
        shell, poses = cloud(90, extent=0.03), poses_in(env.grid, 300, beyond=0.0)
        plenty = env.touch(shell, poses=poses)
        told: list[tuple[int, int]] = []
        for jobs in (1, 4):
            with env.batch_tool(shell, budget_bytes=LEAST_BUDGET, jobs=jobs) as batch_tool:
                assert batch_tool.size_bytes <= LEAST_BUDGET
                told.clear()
                scarce = batch_tool.touch(poses, progress=lambda *done: told.append(done))
                assert batch_tool.n_loaded > 512  # cells left, and were read again
            assert (scarce.forces + 0.0).tobytes() == (plenty.forces + 0.0).tobytes()
            assert (scarce.torques + 0.0).tobytes() == (plenty.torques + 0.0).tobytes()
            assert scarce.hits.tolist() == plenty.hits.tolist()
            with env.batch_tool(shell, budget_bytes=LEAST_BUDGET, jobs=jobs) as batch_tool:
                assert batch_tool.collides(poses).tolist() == (plenty.hits > 0).tolist()
                assert batch_tool.n_loaded > 512
            assert [total for _, total in told] == [300] * len(told)
            assert [done for done, _ in told] == sorted({done for done, _ in told})
            assert told[-1] == (300, 300)
        assert plenty.hits.any()
        touch = env.touch(shell, poses[7])
        assert (plenty.forces[7] + 0.0).tobytes() == (touch.force + 0.0).tobytes()


def test_touch_batch_objects_by_pose(tmp_path: Path) -> None:
    with make(tmp_path, 6) as env:
        write_voxels(env.store, block((0, 0, 0), (63, 63, 3)), "floor")
        write_voxels(env.store, block((0, 0, 60), (63, 63, 63)), "lid")
        write_voxels(env.store, block((30, 30, 30), (31, 31, 31)), "nut")
        shell = PointShell(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.zeros(3))
        poses = np.tile(np.eye(4), (3, 1, 1))
        poses[:, 2, 3] = env.grid.centers(np.array([[0, 0, 61], [0, 0, 20], [0, 0, 1]]))[:, 2]
        felt = env.touch(shell, poses=poses, objects=True)
        assert [felt.ids_at(n) for n in range(3)] == [[2], [], [1]]
        assert felt.ids_at(-1) == [1]
        assert felt.ids.tolist() == [2, 1]
        assert [obj.name for obj in felt.objects] == ["floor", "lid"]
        with pytest.raises(IndexError):
            felt.ids_at(3)
        with pytest.raises(UsageError, match="objects=True"):
            _ = env.touch(shell, poses=poses).ids


def test_touch_batch_bad_input(tmp_path: Path) -> None:
    with make(tmp_path, 6) as env:
        scatter(env)
        shell, poses = cloud(5), poses_in(env.grid, 4)
        bent, lost = poses.copy(), poses.copy()
        bent[2, 0, 0] += 0.5
        lost[3, 1, 3] = np.nan
        for wrong, told in ((bent, "pose 2: .*rotation"), (lost, "pose 3: .*finite")):
            with pytest.raises(UsageError, match=told) as caught:
                env.touch(shell, poses=wrong)
            assert "\n" not in str(caught.value)
            for ask in (env.clearance, env.collides):
                with pytest.raises(UsageError, match=told):
                    ask(shell, wrong)
        for shape in ((4, 4), (2, 3, 3)):
            with pytest.raises(UsageError, match="shape"):
                env.touch(shell, poses=np.zeros(shape))
        frozen = poses.copy()
        frozen.flags.writeable = False
        for given_poses in (frozen, poses.tolist()):
            felt = env.touch(shell, poses=given_poses)
            assert felt.forces.tobytes() == env.touch(shell, poses=poses).forces.tobytes()
        with pytest.raises(UsageError, match="real numbers"):
            env.touch(shell, poses=poses.astype(complex))
        with pytest.raises(UsageError, match="one pose, or poses"):
            env.touch(shell)  # type: ignore[call-overload]
        with pytest.raises(UsageError, match="one pose, or poses"):
            env.touch(shell, poses[0], poses=poses)  # type: ignore[call-overload]
        with pytest.raises(UsageError, match="strategy 'array' for many poses"):
            env.touch(shell, strategy="array", poses=poses)  # type: ignore[call-overload]
        with pytest.raises(ObjectNotFoundError, match="exclude"):
            env.touch(shell, poses=poses, exclude=["no such part"])
        for jobs in (0, -1, 1000):
            with pytest.raises(UsageError, match="jobs"):
                env.batch_tool(shell, jobs=jobs)
        with pytest.raises(UsageError, match="budget"):
            env.batch_tool(shell, budget_bytes=1000)
    with (
        make(tmp_path, 6, curve="lexicographic", layout="voxel") as plain,
        pytest.raises(UsageError, match="lexicographic"),
    ):
        plain.touch(shell, poses=poses)
