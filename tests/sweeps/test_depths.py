"""How deep a tool goes into what it touches at its start: closed forms, and exact boxes."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import hapticdb
from extraction_scenes import box, imported, joined
from hapticdb import Grid, PointShell
from hapticdb.cli.csv_files import rows_of_sweep
from hapticdb.pointshell.orientation import Surface, orient
from hapticdb.sweeps.depths import MOST_LOOKS, DepthSearch
from hapticdb.sweeps.path import SweepPath
from hapticdb.sweeps.record import sweep_record
from hapticdb.sweeps.result import ContactDepth, Swept
from hapticdb.sweeps.run import sweep
from hapticdb.sweeps.solid import Solid
from hapticdb.sweeps.verdict import verdict_line
from hapticdb.testing import voxel_object
from moving_boxes import mesh

Floats = NDArray[np.float64]

SIZE = 0.01
ROUND = 1e-6
"""Metres: vertices in single precision, as the files have them, are nearer to the exact ones."""

DOT = PointShell(np.zeros((1, 3)), np.eye(3)[:1], np.zeros(3))


def moved(*ways: tuple[float, float, float]) -> Floats:
    poses = np.tile(np.eye(4), (len(ways) + 1, 1, 1))
    poses[1:, :3, 3] = ways
    return poses


def swept(url: Path, name: str, poses: Floats, tolerance: float | None = None) -> Swept:
    with hapticdb.open(url, read_only=True) as env:
        shell = env.shell(name, spacing=0.5 * SIZE)
        return sweep(env, shell, poses, exclude=(name,), leave_start=True, tolerance=tolerance)


def peg(folder: Path) -> Path:
    """A peg of 4 by 4 voxels in a square hole without play, which is open at its top."""
    sides = [
        box((0.02, -0.08, 0.0), (0.08, 0.08, 0.1)),
        box((-0.08, -0.08, 0.0), (-0.02, 0.08, 0.1)),
        box((-0.02, 0.02, 0.0), (0.02, 0.08, 0.1)),
        box((-0.02, -0.08, 0.0), (0.02, -0.02, 0.1)),
    ]
    return imported(
        folder, SIZE, block=joined(*sides), peg=box((-0.02, -0.02, 0.0), (0.02, 0.02, 0.15))
    )


@pytest.mark.long
def test_a_peg_pulled_along_its_hole_gets_no_deeper(tmp_path: Path) -> None:
    found = swept(peg(tmp_path), "peg", moved((0.0, 0.0, 0.2)))
    (depth,) = found.depths
    assert found.verdict == "comes out"
    assert (depth.is_bounded, depth.is_cut, depth.why) == (True, False, "")
    assert depth.at_start <= ROUND
    assert depth.deepest <= ROUND
    assert depth.deepest_most <= 0.5 * SIZE


@pytest.mark.parametrize("way", [pytest.param(0.009, marks=pytest.mark.long), 0.016])
def test_a_peg_pulled_across_its_hole_cuts_as_deep_as_the_way(tmp_path: Path, way: float) -> None:
    """Half the peg's width at most: there the other side of the peg is nearer."""
    found = swept(peg(tmp_path), "peg", moved((way, 0.0, 0.0)))
    (depth,) = found.depths
    assert found.verdict == "hits"
    assert depth.is_cut
    assert depth.deepest <= way + ROUND
    assert depth.deepest == pytest.approx(way, abs=0.2 * SIZE)
    assert way <= depth.deepest_most <= way + SIZE
    assert verdict_line(found, DOT).startswith("cuts into block; ")


@pytest.mark.long
def test_the_tolerance_is_how_much_deeper_it_may_get(tmp_path: Path) -> None:
    found = swept(peg(tmp_path), "peg", moved((0.009, 0.0, 0.0)), tolerance=0.015)
    (depth,) = found.depths
    assert (found.verdict, depth.is_bounded, depth.allowed) == ("comes out", True, 0.015)
    assert 0.009 - ROUND <= depth.deepest_most <= 0.015


@pytest.mark.long
def test_two_thin_sheets_that_pass_each_other_are_not_taken_for_sliding(tmp_path: Path) -> None:
    """No place is ever deeper than a tenth of a voxel, yet one goes right through the other."""
    thin = 0.2 * SIZE
    url = imported(
        tmp_path, SIZE, lying=box((-0.1, -0.1, 0.0), (0.1, 0.1, thin)),
        standing=box((-0.05, 0.0, thin), (0.05, thin, 0.1)),
    )  # fmt: skip
    (depth,) = swept(url, "standing", moved((0.0, 0.0, -0.3)), tolerance=SIZE).depths
    assert depth.deepest_most <= SIZE
    assert not depth.is_bounded
    assert "too thin" in depth.why


def test_what_is_open_on_both_sides_has_no_depth(tmp_path: Path) -> None:
    lower, upper = box((0.0, 0.0, 0.0), (0.1, 0.1, 0.05)), box((0.0, 0.0, 0.05), (0.1, 0.1, 0.1))
    for made in (lower, upper):
        made.update_faces(np.arange(len(made.faces)) > 1)
    url = imported(tmp_path, SIZE, lower=lower, upper=upper)
    found = swept(url, "upper", moved((0.0, 0.0, 0.2)))
    (depth,) = found.depths
    assert not depth.is_bounded
    assert not depth.is_cut
    assert (found.verdict, found.comes_out, found.at_least) == ("not decided", False, 0.0)
    line = verdict_line(found, DOT)
    assert line.startswith("not decided: meets nothing else, but how deep it goes into lower is")
    assert "nothing has an inside" in line
    assert line.endswith("free of lower, or leave that out by --exclude")
    shell = PointShell.from_mesh(upper.vertices, upper.faces, 20)
    record = sweep_record(found, shell, [], [])
    assert (record["verdict"], record["comes_out"]) == ("not decided", False)
    (depth_record,) = record["depths"]
    assert (depth_record["deepest_most"], depth_record["is_bounded"]) == (None, False)
    assert {row[9] for row in rows_of_sweep(found)} == {"not decided"}


@pytest.mark.long
def test_a_depth_that_its_bounds_leave_open_is_not_decided(tmp_path: Path) -> None:
    """The peg moves by what is allowed: no finer look tells whether it cuts."""
    url = peg(tmp_path)
    across = moved((0.5 * SIZE, 0.0, 0.0))
    found = swept(url, "peg", across)
    assert [one.object.name for one in found.undecided] == ["block"]
    assert found.verdict == "not decided"
    line = verdict_line(found, DOT)
    assert "comes out" not in line
    tolerance = re.search(r"--tolerance ([0-9.]+) may decide it$", line)
    assert tolerance is not None
    assert swept(url, "peg", across, 1e-3 * float(tolerance[1])).verdict == "comes out"


def test_a_cut_is_told_although_another_depth_is_not_known(tmp_path: Path) -> None:
    """The peg also stands on a block that is pierced by it, and whose lid is missing."""
    sides = [
        box((0.02, -0.08, 0.0), (0.08, 0.08, 0.1)),
        box((-0.08, -0.08, 0.0), (-0.02, 0.08, 0.1)),
    ]
    standing = box((-0.02, -0.02, 0.0), (0.02, 0.02, 0.15))
    standing.update_faces(np.arange(len(standing.faces)) > 1)
    floor = box((-0.08, -0.08, -0.05), (0.08, 0.08, 0.0))
    floor.update_faces(np.arange(len(floor.faces)) > 1)
    url = imported(tmp_path, SIZE, block=joined(*sides), floor=floor, peg=standing)
    found = swept(url, "peg", moved((0.03, 0.0, 0.0)))
    depths = {one.object.name: one for one in found.depths}
    assert "nothing has an inside" in depths["floor"].why
    assert depths["block"].is_cut
    assert found.verdict == "hits"


def test_a_file_that_is_gone_leaves_the_depth_open(tmp_path: Path) -> None:
    url = peg(tmp_path)
    with hapticdb.open(url, read_only=True) as env:
        shell = env.shell("peg", spacing=0.5 * SIZE)
        (tmp_path / "parts.glb").unlink()
        found = sweep(env, shell, moved((0.0, 0.0, 0.2)), exclude=("peg",), leave_start=True)
    assert found.verdict == "not decided"
    assert ["cannot be read" in one.why for one in found.depths] == [True]


# --- against exact boxes -------------------------------------------------------------------------


def depth_in_box(places: Floats, halves: Floats) -> Floats:
    """Depth (n,) of places (n, 3), in the box's frame, in a box with half edges (3,)."""
    return np.asarray((halves - np.abs(places)).min(axis=1))


def spread(halves: Floats, count: int) -> Floats:
    """Places on all faces of a box, its corners among them."""
    steps = np.linspace(-1.0, 1.0, count)
    u, v = (x.ravel() for x in np.meshgrid(steps, steps))
    faces = [
        np.insert(np.stack([u, v], axis=1), axis, sign, axis=1)
        for axis in range(3)
        for sign in (-1, 1)
    ]
    return np.asarray(np.concatenate(faces) * halves)


edges = st.tuples(*[st.floats(0.01, 0.06)] * 3).map(np.array)
vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=4, deadline=None
)
@given(tool=edges, other=edges, turn=vectors, at=vectors, way=vectors)
def test_depths_hold_between_boxes_at_every_pose(
    tool: Floats, other: Floats, turn: Floats, at: Floats, way: Floats
) -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = 0.06 * at
    poses[1, :3, 3] += 0.05 * way
    poses[1, :3, :3] = Rotation.from_rotvec(0.5 * turn).as_matrix()
    shell = PointShell.from_mesh(mesh(tool).vertices, mesh(tool).faces, 100, seed=1).with_cover()
    path = SweepPath.of(poses, shell, SIZE)
    depth = depth_of(shell, path, mesh(other))
    mine, others = spread(tool, 40), spread(other, 40)
    exact = []
    for pose in path.at(np.linspace(0.0, len(path) - 1.0, 4 * len(path))):
        inner = depth_in_box(mine @ pose[:3, :3].T + pose[:3, 3], other)
        outer = depth_in_box((others - pose[:3, 3]) @ pose[:3, :3], tool)
        exact.append(max(inner.max(), outer.max(), 0.0))
    coarse = 0.12 * np.sqrt(2.0) / 39.0  # places of the oracle are at most so far from any other
    assert exact[0] <= depth.at_start_most + ROUND
    assert max(exact) <= depth.deepest_most + ROUND
    assert depth.at_start <= exact[0] + coarse
    assert depth.deepest <= max(exact) + coarse + path.off
    assert depth.deepest_most - depth.deepest <= SIZE


def depth_of(shell: PointShell, path: SweepPath, made: trimesh.Trimesh) -> ContactDepth:
    assert isinstance(shell.surface, Surface)
    other = Solid(orient(np.array(made.triangles)), SIZE)
    search = DepthSearch(path, len(path), SIZE, 0.005)
    named = voxel_object(Grid(SIZE, (0.0, 0.0, 0.0), 7), np.zeros((1, 3), dtype=np.int64))
    return search.along(named, Solid(shell.surface, SIZE), other, MOST_LOOKS)
