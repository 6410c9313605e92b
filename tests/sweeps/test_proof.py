"""What a sweep proves, against the closed form of a box that moves along an axis."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.sweeps.run import sweep
from hapticdb.testing import write_voxels

SIZE = 0.01
GRID = Grid(SIZE, (0.0, 0.0, 0.0), 7)
MIDDLE = 0.5 * GRID.edge
EDGES = np.array([0.2, 0.12, 0.08])


def scene(url: Path, **objects: list[Any]) -> Environment:
    env = hapticdb.create(url, GRID)
    for name, voxels in objects.items():
        write_voxels(env.store, np.array(voxels, dtype=np.int64), name)
    return env


def box(edges: Any = EDGES) -> trimesh.Trimesh:  # noqa: ANN401 - a triple
    return trimesh.creation.box(edges)


def box_shell(points: int | None = None, seed: int = 0, **options: Any) -> PointShell:  # noqa: ANN401
    made = box()
    return PointShell.from_mesh(made.vertices, made.faces, points, seed=seed, **options)


def at(*places: Any) -> NDArray[np.float64]:  # noqa: ANN401 - triples
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return poses


voxels = st.lists(st.tuples(*[st.integers(40, 90)] * 3), min_size=1, max_size=4)


@pytest.mark.long
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    placed=voxels,
    start=st.tuples(*[st.floats(0.4, 0.9)] * 3),
    axis=st.integers(0, 2),
    way=st.floats(-0.3, 0.3),
    n_points=st.sampled_from([30, 300, 3000]),
    seed=st.integers(0, 3),
)
def test_what_comes_out_meets_no_voxel_on_its_way_and_what_keeps_away_comes_out(
    tmp_path_factory: pytest.TempPathFactory,
    placed: list[Any],
    start: tuple[float, float, float],
    axis: int,
    way: float,
    n_points: int,
    seed: int,
) -> None:
    shell = box_shell(n_points, seed).with_cover()
    end = np.array(start)
    end[axis] += way
    with scene(tmp_path_factory.mktemp("s") / "s.db", dots=placed) as env:
        found = sweep(env, shell, at(start, end))
    low = np.minimum(start, end) - 0.5 * EDGES
    high = np.maximum(start, end) + 0.5 * EDGES
    corner = np.array(placed) * SIZE
    gaps = np.maximum(np.maximum(low - corner - SIZE, corner - high), 0.0)
    apart = float(np.linalg.norm(gaps, axis=1).min())  # the swept box's distance to any voxel
    if found.verdict == "comes out":
        assert apart > 0.0
        assert found.clearance is not None
        assert found.clearance.at_least <= apart
    if found.verdict == "hits":
        assert apart == 0.0
    assert shell.cover is not None
    if apart > 1.001 * (shell.cover + 0.25 * SIZE):
        assert found.verdict == "comes out"


@pytest.mark.parametrize("seed", range(2))
def test_a_rod_between_the_points_is_not_missed(tmp_path: Path, seed: int) -> None:
    """A rod of a voxel's width passes through the tool's widest face, between its points."""
    rod = [(i, 64, 64) for i in range(20, 100)]
    aside = at((MIDDLE + 0.005, MIDDLE - 0.2, MIDDLE), (MIDDLE + 0.005, MIDDLE + 0.2, MIDDLE))
    with scene(tmp_path / "s.db", rod=rod) as env:
        coarse = sweep(env, box_shell(60, seed), aside)
        assert coarse.verdict != "comes out"
        dense = sweep(env, box_shell(seed=seed, spacing=0.5 * SIZE), aside)
        assert dense.verdict == "hits"
        assert [one.object.name for one in dense.objects] == ["rod"]


def test_a_finer_shell_is_drawn_where_it_is_tight(tmp_path: Path) -> None:
    """The path begins 1.5 voxels above the dot, and leads away."""
    with scene(tmp_path / "s.db", dot=[(64, 64, 64)]) as env:
        over = MIDDLE + 0.5 * SIZE
        poses = at((over, over, MIDDLE + 2.5 * SIZE + 0.04), (over, over, MIDDLE + 0.3))
        assert sweep(env, box_shell(60), poses).verdict == "not decided"
        found = sweep(env, box_shell(60), poses, refine=True)
        assert found.verdict == "comes out"
        assert found.decision is not None
        assert 0.0 < found.at_least <= 1.5 * SIZE
        assert found.decision.by == "voxels"


def test_a_part_in_a_closed_tool_is_found_although_the_proof_is_fine(tmp_path: Path) -> None:
    """A nut close to the tool's wall: the surfaces never meet, and it does not come out."""
    below = round((MIDDLE - 0.5 * EDGES[2]) / SIZE)  # the layer of voxels above the tool's floor
    nut = [(i, 64, below + 1) for i in range(60, 68)]
    shell = box_shell(spacing=0.5 * SIZE)
    with scene(tmp_path / "s.db", nut=nut) as env:
        for end in ((MIDDLE, MIDDLE, MIDDLE), (MIDDLE, MIDDLE, MIDDLE - 0.004)):
            found = sweep(env, shell, at((MIDDLE, MIDDLE, MIDDLE), end), refine=True)
            assert found.verdict != "comes out"
            assert [one.object.name for one in found.objects] == []


def test_bounds_of_earlier_poses_spare_looking(tmp_path: Path) -> None:
    """Far from everything, steps are as long as the clearance allows."""
    with scene(tmp_path / "s.db", dot=[(64, 64, 64)]) as env:
        far = sweep(env, box_shell(300), at((0.2, 0.2, 0.2), (0.2, 1.0, 0.2)))
        assert (far.hits, far.samples) == (0, 161)
        assert far.looked < far.samples / 4
        through = sweep(env, box_shell(3000), at((0.2, MIDDLE, MIDDLE), (1.0, MIDDLE, MIDDLE)))
        assert 0 < through.hits < through.looked < 2 * through.samples


def test_a_shell_of_unknown_cover_comes_out_nowhere(tmp_path: Path) -> None:
    shell = PointShell(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.zeros(3), is_closed=False)
    with scene(tmp_path / "s.db", dot=[(5, 5, 5)]) as env:
        found = sweep(env, shell, at((MIDDLE, MIDDLE, MIDDLE)))
    assert (found.hits, found.verdict) == (0, "not decided")


# --- objects inside the tool ---------------------------------------------------------------------

INSIDE = [(64, 64, 64), (65, 64, 64)]


def test_what_lies_inside_a_closed_tool_is_hit(tmp_path: Path) -> None:
    beside = [(64, 100, 64)]
    with scene(tmp_path / "s.db", nut=INSIDE, beside=beside) as env:
        poses = at((MIDDLE, MIDDLE, MIDDLE), (MIDDLE + 0.01, MIDDLE, MIDDLE))
        found = sweep(env, box_shell(3000), poses)
        assert (found.hits, found.verdict) == (0, "hits")
        assert [obj.name for obj in found.enclosed] == ["nut"]
        free = sweep(env, box_shell(3000), poses, exclude=[1])
        assert (free.verdict, free.enclosed) == ("comes out", ())


def test_an_open_tool_and_a_void_enclose_nothing(tmp_path: Path) -> None:
    outer, void = box(), box(0.8 * EDGES)
    hollow = trimesh.util.concatenate([outer, void])
    with scene(tmp_path / "s.db", nut=INSIDE) as env:
        poses = at((MIDDLE, MIDDLE, MIDDLE))
        opened = PointShell.from_mesh(outer.vertices, outer.faces[:-1], 3000)
        assert sweep(env, opened, poses).verdict == "comes out"
        assert (
            sweep(env, PointShell.from_mesh(hollow.vertices, hollow.faces, 6000), poses).verdict
            == "comes out"
        )


def test_many_voxels_inside_are_found_by_bricks_and_by_voxels(tmp_path: Path) -> None:
    """A block of which some bricks lie wholly inside the tool, and some only in part."""
    block = [(i, j, k) for i in range(50, 78) for j in range(60, 69) for k in range(62, 67)]
    with scene(tmp_path / "s.db", block=block, far=[(10, 10, 10)]) as env:
        pose = at((MIDDLE, MIDDLE, MIDDLE + 0.5 * SIZE))
        big = trimesh.creation.box((0.4, 0.3, 0.3))
        for mesh in (big, box((0.33, 0.14, 0.1))):
            shell = PointShell.from_mesh(mesh.vertices, mesh.faces, 20_000)
            found = sweep(env, shell, pose)
            assert [obj.name for obj in found.enclosed] == ["block"]


def test_a_saved_shell_does_not_know_what_is_inside(tmp_path: Path) -> None:
    box_shell(3000).with_cover().save(tmp_path / "tool.npz")
    saved = PointShell.load(tmp_path / "tool.npz")
    with scene(tmp_path / "s.db", nut=INSIDE) as env:
        found = sweep(env, saved, at((MIDDLE, MIDDLE, MIDDLE)))
        assert (found.verdict, found.proof.is_clear) == ("not decided", True)
        assert sweep(env, saved, at((0.3, 0.3, 0.3))).verdict == "comes out"


# --- each object by itself -----------------------------------------------------------------------


def test_each_object_has_its_own_intervals(tmp_path: Path) -> None:
    """The tool's wall starts inside one object and leaves it at once; it meets another later."""
    begins, end = 20, 20 + round(EDGES[0] / SIZE)  # range of voxels along x of the tool's box
    with scene(tmp_path / "s.db", left=[(end - 1, 64, 64)], later=[(begins - 10, 64, 64)]) as env:
        start = np.array([(0.5 * (begins + end) - 0.2) * SIZE, MIDDLE, MIDDLE])
        there = start - np.array([0.3, 0.0, 0.0])
        shell = box_shell(spacing=0.5 * SIZE)
        left, later = sweep(env, shell, at(start, there)).objects
        assert (left.object.name, later.object.name) == ("left", "later")
        assert left.is_left_at_once
        assert not later.is_left_at_once
        assert left.first_contact is not None
        assert left.first_contact.sample <= 1
        assert left.length == pytest.approx(0.8 * SIZE, abs=0.51 * SIZE)
        # the front face passes the voxel, and at the end the back face does
        assert later.first == pytest.approx(8.8 * SIZE / 0.3, abs=0.51 * SIZE / 0.3)
        assert len(later.intervals) == 2
        again = sweep(env, shell, at(start, there, start)).objects
        assert not any(one.is_left_at_once for one in again)
