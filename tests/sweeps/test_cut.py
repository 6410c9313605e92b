"""How deep two surfaces overlap, against closed forms."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb.kernels.surfaces.sides import triangle_tree
from hapticdb.sweeps.cut import Mesh, cut

Floats = NDArray[np.float64]

SHEET = trimesh.Trimesh(
    [[-5, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]], [[0, 1, 2], [0, 2, 3]], process=False
)
BOX = trimesh.creation.box((10.0, 10.0, 10.0))
PLATE = trimesh.creation.box((40.0, 40.0, 10.0))
RING = trimesh.creation.annulus(4.0, 12.0, 10.0, sections=64)


SHIFT = 1e-4


def depth(one: trimesh.Trimesh, other: trimesh.Trimesh, *place: float, turn: float = 0.0) -> float:
    """Cut of `other` at a place, turned about x; the same both ways and in any frame."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("x", turn, degrees=True).as_matrix()
    pose[:3, 3] = place
    rng = np.random.default_rng(5)
    frame = np.eye(4)
    frame[:3, :3] = Rotation.random(rng=rng).as_matrix()
    frame[:3, 3] = rng.uniform(-9.0, 9.0, 3)

    def told(here: Mesh, there: Mesh, placed: Floats) -> float:
        return cut(here, there, placed, 100.0, SHIFT, 0.0).depth

    found = told(mesh(one), mesh(other), pose)
    back = told(mesh(other), mesh(one), np.asarray(np.linalg.inv(pose), dtype=np.float64))
    moved = told(mesh(one, frame), mesh(other), np.asarray(frame @ pose))
    assert back == pytest.approx(found, rel=0.02, abs=2.0 * SHIFT)
    assert moved == pytest.approx(found, rel=0.02, abs=2.0 * SHIFT)
    return found


def mesh(made: trimesh.Trimesh, pose: Floats | None = None) -> Mesh:
    triangles = np.array(made.triangles)
    if pose is not None:
        triangles = triangles @ pose[:3, :3].T + pose[:3, 3]
    return Mesh(triangle_tree(triangles, np.zeros(len(triangles), dtype=np.int64)))


@pytest.mark.parametrize("deep", [0.01, 0.2, 1.0, 3.0])
def test_a_box_stands_as_deep_in_a_plate_as_it_is_pushed(deep: float) -> None:
    assert depth(PLATE, BOX, 1.0, 2.0, 10.0 - deep) == pytest.approx(deep, abs=SHIFT)


@pytest.mark.parametrize("deep", [(1.0, 1.0, 1.0), (5.0, 5.0, 1.0), (0.2, 5.0, 5.0)])
def test_boxes_overlap_by_the_least_way_out(deep: tuple[float, float, float]) -> None:
    x, y, z = deep
    assert depth(BOX, BOX, 10.0 - x, 10.0 - y, 10.0 - z) == pytest.approx(min(deep), abs=SHIFT)


@pytest.mark.parametrize("beside", [0.0, 7.0])
@pytest.mark.parametrize("deep", [0.1, 1.0, 4.0])
def test_open_sheets_cut_by_what_sticks_through(deep: float, beside: float) -> None:
    """The sheet that is parted from border to border, or stuck on another's border."""
    assert depth(SHEET, SHEET, beside, 0.0, 5.0 - deep, turn=90.0) == pytest.approx(deep, abs=SHIFT)


def test_a_thin_plate_is_gone_through_though_both_its_faces_are_near() -> None:
    thin = trimesh.creation.box((40.0, 40.0, 0.1))
    assert depth(thin, BOX, 0.3, 0.2, 2.0) > 2.5


@pytest.mark.parametrize("height", [3.0, 8.0])
def test_a_peg_overlaps_its_hole_by_what_it_is_too_thick(height: float) -> None:
    """Through the hole, and in it; corners of both lie above one another."""
    for more in (0.0, 0.05, 0.2):
        peg = trimesh.creation.cylinder(4.0 + more, 20.0, sections=64)
        assert depth(RING, peg, 0.0, 0.0, height) == pytest.approx(more, abs=0.006)


def test_a_peg_that_fits_does_not_overlap() -> None:
    peg = trimesh.creation.cylinder(3.99, 20.0, sections=64)
    assert depth(RING, peg, 0.0, 0.0, 3.0) == 0.0


def test_flush_boxes_overlap_by_rounding_errors_alone() -> None:
    for down in (0.0, 1e-12, -1e-12, 1e-9):
        assert depth(PLATE, BOX, 1.0, 2.0, 10.0 - down) <= SHIFT


@pytest.mark.parametrize("deep", [0.01, 0.1, 1.0])
def test_a_ball_is_seen_in_the_middle_of_a_large_triangle(deep: float) -> None:
    ball = trimesh.creation.icosphere(4, radius=5.0)
    assert depth(PLATE, ball, 0.3, 0.1, 10.0 - deep) == pytest.approx(deep, rel=0.1)
