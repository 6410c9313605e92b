"""Shells, poses and regions: fixed by a seed, near surfaces, of the stated density."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from hapticdb import Environment, Grid
from hapticdb.bench import workload
from hapticdb.errors import UsageError
from hapticdb.store.base import LAYOUTS, Layout
from hapticdb.testing import blob, write_voxels

GRID = Grid(0.002, (0.1, -0.2, 0.3), 8)


@pytest.fixture(params=LAYOUTS)
def env(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Environment]:
    """An environment of solid balls of several sizes; some share a window."""
    layout: Layout = request.param
    made = hapticdb.create(tmp_path / "e.db", GRID, layout=layout)
    for n, (place, radius) in enumerate(
        [((60, 60, 60), 20), ((200, 60, 60), 6), ((60, 200, 100), 10), ((80, 75, 60), 12)]
    ):
        write_voxels(made.store, blob(n, place, radius), f"ball {n}")
    yield made
    made.close()


def occupied(env: Environment) -> set[tuple[int, ...]]:
    return {tuple(voxel) for obj in env.objects() for voxel in env.voxels(obj.id).tolist()}


def test_a_sphere_shell_has_its_radius_and_looks_inward() -> None:
    shell = workload.sphere_shell(0.002, 500)
    assert len(shell) == 500
    np.testing.assert_allclose(np.linalg.norm(shell.points, axis=1), 0.024, rtol=1e-12)
    np.testing.assert_allclose(shell.normals, -shell.points / 0.024, atol=1e-12)


def test_random_poses_are_rigid_and_within_reach_of_an_occupied_voxel(env: Environment) -> None:
    poses = workload.random_poses(env, 60, seed=3)
    centers = env.grid.centers(np.array(sorted(occupied(env))))
    for pose in poses:
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        nearest = np.linalg.norm(centers - pose[:3, 3], axis=1).min()
        assert nearest <= workload.RADIUS_VOXELS * GRID.voxel_size * (1 + 1e-9)


def test_poses_depend_on_the_seed_alone(env: Environment) -> None:
    first, again = workload.random_poses(env, 20, seed=1), workload.random_poses(env, 20, seed=1)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, workload.random_poses(env, 20, seed=2))


def test_surface_voxels_are_occupied(env: Environment) -> None:
    drawn = workload.surface_voxels(env, 300, np.random.default_rng(0))
    assert len(drawn) == 300
    assert {tuple(voxel) for voxel in drawn.tolist()} <= occupied(env)


def test_a_window_counts_each_occupied_voxel_once(env: Environment) -> None:
    corner = np.array([48, 40, 56])
    found = workload.window_voxels(env, corner, 32)
    expected = [
        v for v in occupied(env) if all(c <= x < c + 32 for x, c in zip(v, corner, strict=True))
    ]
    assert sorted(map(tuple, found.tolist())) == sorted(expected)
    assert len(expected) > 100


def test_regions_grow_in_density_and_their_poses_stay_in_them(env: Environment) -> None:
    found = workload.regions(env, 30, windows=80)
    assert [region.name for region in found] == ["low", "middle", "high"]
    densities = [region.density for region in found]
    assert densities == sorted(densities)
    assert 0 < densities[0] < densities[-1] <= 1
    for region in found:
        middles = env.grid.to_voxel_units(np.ascontiguousarray(region.poses[:, :3, 3]))
        reach = workload.WINDOW + 2 * workload.RADIUS_VOXELS
        assert np.ptp(middles, axis=0).max() <= reach


@pytest.mark.long
def test_layouts_of_one_scene_have_the_same_regions(tmp_path: Path) -> None:
    densities = []
    for layout in LAYOUTS:
        with hapticdb.create(tmp_path / f"{layout}.db", GRID, layout=layout) as env:
            write_voxels(env.store, blob(0, (100, 100, 100), 24))
            densities.append(workload.regions(env, 10, windows=400)[1].density)
    assert densities[0] == pytest.approx(densities[1], rel=0.3)


def test_an_empty_environment_is_refused(tmp_path: Path) -> None:
    with (
        hapticdb.create(tmp_path / "e.db", GRID) as env,
        pytest.raises(UsageError, match="is empty: import a file first"),
    ):
        workload.random_poses(env, 5)
