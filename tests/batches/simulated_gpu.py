"""Checks on numba's simulator of a GPU, which `test_on_gpu` runs in a process of their own."""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from banded import move_points, write_points
from hapticdb import DistanceField, Environment, Grid, TangentPlane
from hapticdb.batches.batch_results import TouchBatch
from hapticdb.batches.batch_tool import BatchTool
from hapticdb.batches.on_gpu import GpuFrames
from hapticdb.errors import UsageError
from hapticdb.kernels import force_law as laws
from hapticdb.kernels.field.distance_law import DistanceFieldLaw
from hapticdb.kernels.gpu import gpu_frames as kernels
from hapticdb.resident import mirror
from hapticdb.resident.table import LEAST_BUDGET
from query import test_second_law as second
from session.worlds import cloud, make, poses_in, random_shell
from voxels import blob, write_voxels

BOUND = 1e-12
"""Largest difference from the processor's sum, relative to it."""
Floats = NDArray[np.float64]


class CopiedLaw(NamedTuple):
    """A user's law that reads distances: another type with the leaves of the distance law."""

    stiffness: float


laws.define(CopiedLaw, laws.LEAVES[DistanceFieldLaw])


class Copied:
    """The same, as a batch tool takes it."""

    stiffness = 1000.0
    for_kernels = CopiedLaw(1000.0)


def sheet(n: int, axis: int, at: float) -> Floats:
    """Points of a square sheet, in voxels of a grid of 8 cells."""
    flat = np.argwhere(np.ones((n, n))) / 3.0 - n / 6.0 + 32.0
    return np.insert(flat, axis, at, axis=1)


@contextmanager
def sheets(folder: Path) -> Iterator[Environment]:
    """Two sheets with distances that cross."""
    with hapticdb.create(folder / "s.db", Grid(0.002, (-0.06,) * 3, 6)) as env:
        for axis in range(2):
            write_points(env.store, sheet(30, axis, 32.3 + 2.0 * axis), f"sheet {axis}")
        yield env


def gpu_of(batch_tool: BatchTool) -> GpuFrames:
    assert batch_tool._gpu is not None
    return batch_tool._gpu


def assert_near(found: TouchBatch, wanted: TouchBatch) -> None:
    """Counts are equal, and depths and sums within the bound."""
    assert wanted.n_contacts.any()
    assert found.hits.tolist() == wanted.hits.tolist()
    assert found.n_contacts.tolist() == wanted.n_contacts.tolist()
    assert np.allclose(found.deepest, wanted.deepest, rtol=BOUND, atol=0.0)
    for ours, theirs in ((found.forces, wanted.forces), (found.torques, wanted.torques)):
        gap = np.linalg.norm(ours - theirs, axis=1)
        assert (gap <= BOUND * np.linalg.norm(theirs, axis=1)).all(), gap


def laws_are_those_of_the_processor(folder: Path) -> None:
    with sheets(folder) as env:
        poses = poses_in(env.grid, 4, beyond=-0.35)
        for n_points in (50, 150):  # of one block, and of several
            shell = cloud(n_points, extent=0.012)
            for on_cpu, on_gpu in (
                (DistanceField(), DistanceField()),
                (TangentPlane(), TangentPlane()),
                (DistanceField(), Copied()),
            ):
                wanted = env.touch(shell, poses=poses, law=on_cpu)
                found = env.touch(shell, poses=poses, law=on_gpu, device="cuda")
                assert_near(found, wanted)
        collides = env.collides(shell, poses, device="cuda")
        assert collides.tolist() == env.collides(shell, poses).tolist()


def a_law_that_no_kernel_knows_is_felt(folder: Path) -> None:
    with hapticdb.create(folder / "e.db", Grid(second.SIZE, second.ORIGIN, second.BITS)) as env:
        for seed, center in ((1, (20, 20, 20)), (2, (26, 22, 20))):
            write_voxels(env.store, blob(seed, center), f"blob {seed}")
        shell = random_shell(60, 60, 8.0, second.SIZE)
        found = env.touch(shell, poses=second.poses(), law=second.Penalty(), device="cuda")
    assert found.hits.any()
    for n, pose in enumerate(second.poses()):
        wanted = second.expected(shell, pose)
        assert found.hits[n] == found.n_contacts[n] == len(wanted.hits)
        assert np.allclose(found.forces[n], wanted.force, rtol=BOUND, atol=0.0)
        assert np.allclose(found.torques[n], wanted.torque, rtol=1e-9, atol=0.0)


def a_frame_repeats_bit_for_bit(folder: Path) -> None:
    with sheets(folder) as env:
        poses = poses_in(env.grid, 4, beyond=-0.35)
        for n_points in (50, 150):
            with env.batch_tool(cloud(n_points, extent=0.012), device="cuda") as batch_tool:
                first, again = batch_tool.touch(poses), batch_tool.touch(poses[::-1])
                assert again.forces[::-1].tobytes() == first.forces.tobytes()
                assert again.torques[::-1].tobytes() == first.torques.tobytes()
                for n, pose in enumerate(poses):
                    one = gpu_of(batch_tool).evaluate(pose)
                    assert one[:6].tolist() == [*first.forces[n], *first.torques[n]]
                    assert one[6:].tolist() == [
                        first.hits[n], first.n_contacts[n], 0.0, first.deepest[n]
                    ]  # fmt: skip


def unknown_is_never_empty(folder: Path) -> None:
    with sheets(folder) as env:
        shell, poses = cloud(50, extent=0.012), poses_in(env.grid, 3, beyond=-0.35)
        with env.batch_tool(shell, device="cuda") as batch_tool:
            gpu = gpu_of(batch_tool)
            ((_, found),) = gpu.run(poses)
            inside = [
                env.grid.contains(
                    np.floor(env.grid.to_voxel_units(shell.points @ p[:3, :3].T + p[:3, 3]))
                ).sum()
                for p in poses
            ]
            assert found.unknown.tolist() == inside
            assert not found.contacts.any()
            batch_tool.touch(poses)
            ((_, found),) = gpu.run(poses)
            assert found.contacts.any()
            assert not found.unknown.any()


def edits_arrive_by_the_slots_that_changed(folder: Path) -> None:
    with sheets(folder) as env:
        shell, poses = cloud(50, extent=0.012), poses_in(env.grid, 4, beyond=-0.35)
        with env.batch_tool(shell, device="cuda") as batch_tool:
            before = batch_tool.touch(poses)
            n_copied = gpu_of(batch_tool).mirror.n_copied
            batch_tool.touch(poses)
            assert gpu_of(batch_tool).mirror.n_copied == n_copied
            with hapticdb.open(env.url) as other:
                move_points(other.store, 1, sheet(12, 0, 22.3) - 14.0)  # in one cell
            after = batch_tool.touch(poses)
            assert after.revision > before.revision
            assert_near(after, env.touch(shell, poses=poses))
            assert (after.forces != before.forces).any()
            env.remove(2)
            assert not batch_tool.touch(poses).n_contacts.any()


def what_the_table_evicts_leaves_the_gpu(folder: Path) -> None:
    with make(folder, 8) as env:
        voxels = np.random.default_rng(0).integers(0, 256, (20_000, 3))
        write_voxels(env.store, np.unique(voxels, axis=0))
        shell, poses = cloud(40, extent=0.03), poses_in(env.grid, 30, beyond=0.0)
        wanted = env.touch(shell, poses=poses)
        for most_listed in (0, mirror.MOST_LISTED):  # by a directory, and by a list of cells
            mirror.MOST_LISTED = most_listed
            with env.batch_tool(shell, budget_bytes=LEAST_BUDGET, device="cuda") as batch_tool:
                found = batch_tool.touch(poses)
                assert batch_tool._residency.writer.n_evicted
                assert_near(found, wanted)


def a_pose_that_is_not_rigid_is_refused(folder: Path) -> None:
    with sheets(folder) as env:
        poses = poses_in(env.grid, 4)
        poses[2, 0, 0] = np.nan
        with env.batch_tool(cloud(5), device="cuda") as batch_tool:
            for ask in (batch_tool.touch, lambda some: gpu_of(batch_tool).evaluate(some[2])):
                with pytest.raises(UsageError, match="no rigid transform"):
                    ask(poses)
            assert batch_tool.touch(poses[:2]).revision == env.store.revision()


CHECKS = (
    laws_are_those_of_the_processor,
    a_law_that_no_kernel_knows_is_felt,
    a_frame_repeats_bit_for_bit,
    unknown_is_never_empty,
    edits_arrive_by_the_slots_that_changed,
    what_the_table_evicts_leaves_the_gpu,
    a_pose_that_is_not_rigid_is_refused,
)

if __name__ == "__main__":
    kernels.THREADS, kernels.THREADS_OF_LARGE, kernels.LARGE_FROM, kernels.MOST_SHARES = (
        2,
        4,
        100,
        3,
    )
    sys.setswitchinterval(1e-4)  # the simulator watches its threads without a pause
    np.seterr(over="ignore")  # a hash in plain Python
    for check in CHECKS:
        with tempfile.TemporaryDirectory() as home:
            check(Path(home))
        print(check.__name__, flush=True)  # noqa: T201 - read by `test_on_gpu`
