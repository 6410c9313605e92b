"""Clearances of a batch against brute force over all points and all voxels."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import hapticdb
from assemblies import box, write_obj
from hapticdb import Environment, GridOptions, ImportOptions, PointShell
from hapticdb.batches import batch_threads, exact
from hapticdb.errors import UsageError
from hapticdb.ingest.geometry import parts_of
from hapticdb.mesh import Part
from hapticdb.resident.table import LEAST_BUDGET
from hapticdb.store.base import Object, Store
from moving_boxes import Boxes, apart, mesh
from session.worlds import HIERARCHICAL, SIZE, block, cloud, ids_by_voxel, make, poses_in, scatter
from voxels import write_voxels

Floats = NDArray[np.float64]
ROUNDING = 1e-9
"""Voxels by which two computations of a distance may differ."""


def distances_by_hand(
    env: Environment, shell: PointShell, poses: Floats, exclude: list[int]
) -> Floats:
    """Least distance (B, N) of each placed point to any voxel's closed box, voxels."""
    voxels = np.array(
        [ijk for ijk, ids in ids_by_voxel(env).items() if not set(ids) <= set(exclude)]
    )
    least = []
    for pose in poses:
        points = env.grid.to_voxel_units(shell.points @ pose[:3, :3].T + pose[:3, 3])[:, None]
        gaps = np.maximum(np.maximum(voxels - points, points - voxels - 1.0), 0.0)
        least.append(np.sqrt((gaps**2).sum(axis=2).min(axis=1)))
    return np.array(least)


def assert_is_right(
    env: Environment, shell: PointShell, poses: Floats, reach: float, exclude: list[int]
) -> None:
    found = env.clearance(shell, poses, reach * SIZE, exclude=exclude)
    by_hand = distances_by_hand(env, shell, poses, exclude)
    expected = by_hand.min(axis=1)
    near = ~found.is_beyond
    assert np.abs(found.distances[near] / SIZE - expected[near]).max(initial=0.0) < ROUNDING
    assert (found.distances[near] <= found.reach).all()
    assert (expected[~near] > reach - ROUNDING).all()
    assert np.isinf(found.distances[~near]).all()
    at_point = by_hand[near, found.points[near]]
    assert np.abs(at_point - expected[near]).max(initial=0.0) < ROUNDING


@given(st.integers(0, 10_000), st.sampled_from([0.7, 5.0, 40.0]))
@settings(max_examples=6)
def test_clearance_batch_equals_brute_force(
    tmp_path_factory: pytest.TempPathFactory, seed: int, reach: float
) -> None:
    """In each layout and curve, in and outside the grid, for tools of any size."""
    rng = np.random.default_rng(seed)
    layout, curve = HIERARCHICAL[seed % 4]
    with make(tmp_path_factory.mktemp("near"), 6, layout, curve) as env:
        scatter(env, n_voxels=int(rng.integers(5, 200)), seed=seed)
        shell = cloud(int(rng.integers(1, 300)), seed, float(rng.choice([0.002, 0.01, 0.03])))
        for exclude in ([], [2]):
            assert_is_right(env, shell, poses_in(env.grid, 12, seed), reach, exclude)


@pytest.mark.parametrize("n_points", [70, 1000, 8000])
def test_clearance_batch_independent_of_cube_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_points: int
) -> None:
    """Dense and sparse shells along a curve, asked again, with a table of any size."""
    with make(tmp_path, 6) as env:
        scatter(env, n_voxels=40)
        along = np.linspace(0.0, 1.0, n_points)
        line = np.stack([along, np.sin(9.0 * along), np.cos(9.0 * along)], axis=1)
        shell = PointShell(0.01 * line, np.tile([0.0, 0.0, 1.0], (n_points, 1)), np.zeros(3))
        poses = poses_in(env.grid, 12)
        expected = distances_by_hand(env, shell, poses, []).min(axis=1)
        for n_cubes in (4, batch_threads.CUBES):
            monkeypatch.setattr(batch_threads, "CUBES", n_cubes)
            with env.batch_tool(shell, jobs=1, law="plane") as batch_tool:
                for reach in (9.0, 3.0, 9.0):
                    found = batch_tool.clearance(poses, reach * SIZE).distances / SIZE
                    within = np.where(expected < reach, expected, np.inf)
                    assert found == pytest.approx(within, abs=ROUNDING)


def test_clearance_batch_threads_same_distances(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cells within reach of all poses do not fit into the table together."""
    monkeypatch.setattr(batch_threads, "CHUNK_POSES", 3)
    with make(tmp_path, 8) as env:
        ijk = np.unique(np.random.default_rng(0).integers(0, 256, (3000, 3)), axis=0)
        write_voxels(env.store, ijk)
        shell, poses = cloud(90, extent=0.02), poses_in(env.grid, 40, beyond=0.05)
        expected = distances_by_hand(env, shell, poses, []).min(axis=1)
        expected[expected >= 16.0] = np.inf
        for jobs in (1, 4):
            told: list[tuple[int, int]] = []
            with env.batch_tool(
                shell, budget_bytes=LEAST_BUDGET, jobs=jobs, law="plane"
            ) as batch_tool:
                found = batch_tool.clearance(
                    poses, 16.0 * SIZE, progress=lambda *done, told=told: told.append(done)
                )
                assert batch_tool.n_loaded > 200
            assert found.distances / SIZE == pytest.approx(expected, abs=ROUNDING)
            assert told[-1] == (40, 40)


def test_clearance_batch_point_above_floor(tmp_path: Path) -> None:
    with make(tmp_path, 7) as env:
        write_voxels(env.store, block((0, 0, 0), (127, 127, 63)), "floor")  # its top is z = 0
        shell = PointShell(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.zeros(3))
        heights = np.array([0.05, 0.0003, -0.001, 0.02, 0.041, 0.0])
        poses = np.tile(np.eye(4), (6, 1, 1))
        poses[:, 2, 3] = heights
        found = env.clearance(shell, poses, 0.04)
        above = [np.inf, 3e-4, 0.0, 0.02, np.inf, 0.0]
        assert found.distances == pytest.approx(above, rel=0.0, abs=1e-12)
        assert found.points.tolist() == [-1, 0, 0, 0, -1, 0]
        poses[:, :3, 3] = np.ldexp(1.0, 70) * np.array([[1.0, 0.0, -1.0]] * 6)
        assert env.clearance(shell, poses, 0.04).distances.tolist() == [np.inf] * 6


def test_clearance_batch_bad_reach(tmp_path: Path) -> None:
    with make(tmp_path, 10) as env:
        poses = poses_in(env.grid, 2)
        assert env.clearance(cloud(50), poses).distances.tolist() == [np.inf] * 2  # empty
        scatter(env)
        for reach in (0.0, -1.0, np.nan, np.inf):
            with pytest.raises(UsageError, match="finite length above 0"):
                env.clearance(cloud(5), poses, reach)
        with (
            env.batch_tool(cloud(5), budget_bytes=LEAST_BUDGET) as batch_tool,
            pytest.raises(UsageError, match="more cells around a point"),
        ):
            batch_tool.clearance(poses, 400 * SIZE)


def test_clearance_exact_boxes(tmp_path: Path) -> None:
    """Of surfaces, whatever the voxels: two boxes, and a box at poses around them."""
    rng = np.random.default_rng(2)
    halves = np.array([[0.05, 0.02, 0.03], [0.01, 0.06, 0.02]])
    places = np.tile(np.eye(4), (2, 1, 1))
    places[:, :3, :3] = Rotation.random(2, rng=rng).as_matrix()
    places[:, :3, 3] = [[-0.1, 0.0, 0.0], [0.1, 0.02, 0.0]]
    scene = trimesh.Scene()
    for n in range(2):
        scene.add_geometry(mesh(halves[n]), node_name=f"box{n}", transform=places[n])
    file = tmp_path / "boxes.glb"
    file.write_bytes(scene.export(file_type="glb"))
    options = ImportOptions(grid=GridOptions(bits=4), distances=False)
    hapticdb.import_files(tmp_path / "boxes.db", [file], options)
    half = np.array([0.02, 0.01, 0.03])
    made = mesh(half)
    shell = PointShell.from_mesh(made.vertices, made.faces)
    count, reach = 40, 0.15
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(-0.2, 0.2, (count, 3))
    poses[0, :3, 3] = (places[0] @ [halves[0, 0], 0.0, 0.0, 1.0])[:3]  # in a side
    expected, _ = apart(half, poses, Boxes(places, halves))
    with hapticdb.open(tmp_path / "boxes.db") as env:
        found = env.clearance(shell, poses, reach, exact=True)
        only = env.clearance(shell, poses, where=["box1"], exact=True)
        met = env.collides(shell, poses, exact=True)
        between = env.distance("box0", "box1")
        with pytest.raises(UsageError, match="two different"):
            env.distance("box0", "box0")
        with pytest.raises(UsageError, match="above 0"):
            env.clearance(shell, poses, -1.0, exact=True)
        with pytest.raises(UsageError, match="no surface"):
            env.clearance(cloud(9), poses, exact=True)
        with pytest.raises(UsageError, match="pose 1"):
            env.collides(shell, np.stack([np.eye(4), 2.0 * np.eye(4)]), exact=True)
        with pytest.raises(UsageError, match="on processors"):
            env.clearance(shell, poses, exact=True, device="cuda")
    least = expected.min(axis=1)
    assert met.tolist() == (least == 0.0).tolist()
    assert 0 < met.sum() < count
    assert found.distances == pytest.approx(np.where(least < reach, least, np.inf), abs=1e-8)
    assert only.distances == pytest.approx(expected[:, 1], abs=1e-8)
    assert found.is_beyond.tolist() == (least >= reach).tolist()
    assert "with nothing within 0.15 m" in repr(found)
    assert "0 with nothing there, least" in repr(only)
    wanted, _ = apart(halves[1], places[1:], Boxes(places[:1], halves[:1]))
    assert between.at_least == pytest.approx(float(wanted[0, 0]), abs=1e-7)
    assert (between.a.name, between.b.name) == ("box0", "box1")
    assert np.linalg.norm(between.on_a - between.on_b) == pytest.approx(between.at_most)


def test_clearance_chord_error_bounds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cubes of 0.1 m, 0.2 and 0.35 m from the first one, each with a chord error of 0.05 m.

    The third one's AABB is beyond the upper bound, so its surface is not read.
    """
    read: list[str] = []
    cubes = {f"box{n}": box((x, 0, 0), (x + 0.1, 0.1, 0.1)) for n, x in enumerate((0, 0.3, 0.45))}
    write_obj(tmp_path / "row.obj", cubes)
    options = ImportOptions(grid=GridOptions(bits=6), distances=False)
    hapticdb.import_files(tmp_path / "row.db", [tmp_path / "row.obj"], options)

    def with_chords(store: Store, objects: list[Object]) -> Iterator[tuple[Object, Part]]:
        for obj, part in parts_of(store, objects):
            read.append(obj.name)
            yield obj, replace(part, chord=0.05)

    monkeypatch.setattr(exact, "parts_of", with_chords)
    with hapticdb.open(tmp_path / "row.db") as env:
        near = env.distance("box0", "*")
        assert read == ["box0", "box1"]
        touching = env.distance("box1", "box2")
    assert (near.b.name, touching.at_least) == ("box1", 0.0)
    assert (near.at_least, near.at_most) == pytest.approx((0.1, 0.3), abs=1e-6)
    assert touching.at_most == pytest.approx(0.15, abs=1e-6)
