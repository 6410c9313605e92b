"""Points drawn inward: as far in as was asked for, nowhere nearer to the surface, none missing."""

import itertools
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

from hapticdb.errors import UsageError
from hapticdb.pointshell.shell import PointShell
from pointshell.test_pointshell import Mesh, cube, hull_of, sphere, together

Floats = NDArray[np.float64]

INSET = 0.1
NEAR = 0.98 * INSET
"""Least distance of an image from the surface: two hundredths of the inset are the tolerance."""


def box(sides: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
    return hull_of(cube()[0] * sides + at)


def cylinder(radius: float, length: float, n: int) -> Mesh:
    angle = 2.0 * np.pi * np.arange(n) / n
    ring = np.stack((radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle), axis=1)
    return hull_of(np.concatenate((ring, ring + np.array([0.0, 0.0, length]))))


def wedge(degrees: float) -> Mesh:
    """A prism of length 1.5 along y, its sharp edge the y axis; it opens towards +x."""
    half = np.radians(degrees / 2.0)
    x, z = np.cos(half), np.sin(half)
    side = np.array([[0.0, 0, 0], [x, 0, z], [x, 0, -z]])
    return hull_of(np.concatenate((side, side + np.array([0.0, 1.5, 0.0]))))


def plane_distances(points: Floats, corners: Floats) -> Floats:
    """Distance of points inside a convex body from its surface: the least over all its planes."""
    planes = ConvexHull(corners).equations
    inside: Floats = -(points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    return inside


def nearest_to(points: Floats, positions: Floats) -> Floats:
    return np.asarray(cKDTree(points).query(positions)[0])


def test_inset_box_faces_exact() -> None:
    shell = PointShell.from_mesh(*box((1, 1, 1)), 3000, inset=INSET)
    depth = np.minimum(shell.points, 1.0 - shell.points)
    assert depth.min() >= NEAR
    # The image lies on the inward normal: along it, as deep as the shell says.
    axis = np.abs(shell.normals).argmax(axis=1)
    along = depth[np.arange(len(shell)), axis]
    assert np.allclose(along, shell.inset, atol=1e-12)
    assert shell.inset.min() >= NEAR
    assert np.median(shell.inset) == INSET
    # An edge of 90 degrees: 1 / sin(45) = 1.414 insets to the nearest point; a corner: 1.732.
    edge = np.stack([np.linspace(0.2, 0.8, 50), np.zeros(50), np.zeros(50)], axis=1)
    spacing = np.sqrt(6.0 * 0.8**2 / 3000)
    late = nearest_to(shell.points, edge)
    assert late.min() >= 2.0**0.5 * NEAR
    assert late.max() <= np.hypot(2.0**0.5 * INSET, spacing) + 0.1 * INSET
    corner = nearest_to(shell.points, np.zeros((1, 3)))[0]
    assert 3.0**0.5 * NEAR <= corner <= 3.0**0.5 * INSET + 1.5 * spacing


@pytest.mark.parametrize("degrees", [15.0, 55.0])
def test_inset_sharp_wedge_maximal_depth(degrees: float) -> None:
    corners, faces = wedge(degrees)
    shell = PointShell.from_mesh(corners, faces, 2000, inset=INSET)
    edge = np.stack([np.zeros(40), np.linspace(0.3, 1.2, 40), np.zeros(40)], axis=1)
    assert nearest_to(shell.points, edge).max() < INSET
    # In the wedge's middle plane, at l from the edge, a point is l sin(a / 2) from both faces.
    middle = (shell.points[:, 1] > 0.3) & (shell.points[:, 1] < 1.2) & (shell.inset < 0.9 * INSET)
    middle &= shell.points[:, 0] < 0.5
    assert middle.sum() > 20
    assert np.abs(shell.points[middle, 2]).max() < 0.03 * INSET
    deep = np.hypot(shell.points[middle, 0], 0.0) * np.sin(np.radians(degrees / 2.0))
    assert np.allclose(shell.inset[middle], deep, atol=0.03 * INSET)


def test_inset_thin_plate_half_thickness() -> None:
    shell = PointShell.from_mesh(*box((1, 1, 0.08)), 500, inset=INSET)
    assert np.allclose(shell.points[:, 2], 0.04, atol=0.002)
    assert np.allclose(shell.inset, 0.04, atol=0.002)
    low, high = shell.points[:, :2].min(axis=0), shell.points[:, :2].max(axis=0)
    assert np.allclose(low, 0.04, atol=0.02)
    assert np.allclose(high, 0.96, atol=0.02)


def test_inset_open_sheet_unchanged() -> None:
    corners, faces = sphere(n=800)
    cap = faces[(corners[faces][:, :, 2] > 0.8).all(axis=1)]
    there, shell = (PointShell.from_mesh(corners, cap, 200, inset=d) for d in (0.0, INSET))
    assert not shell.is_closed
    assert (shell.inset == 0.0).all()
    assert nearest_to(shell.points, there.points).max() < 0.15


def test_inset_solid_with_hole() -> None:
    corners, faces = sphere(n=800)
    torn = faces[3:]
    shell = PointShell.from_mesh(corners, torn, 300, inset=INSET)
    assert not shell.is_closed
    radii = np.linalg.norm(shell.points, axis=1)
    assert np.mean(np.abs(radii - (1.0 - INSET)) < 0.01) > 0.98


def test_inset_close_bodies_separate() -> None:
    pair = together(box((1, 1, 1)), box((1, 1, 1), at=(1.03, 0, 0)))
    shell = PointShell.from_mesh(*pair, 1000, inset=INSET)
    local = np.where(shell.points[:, :1] > 1.015, shell.points - (1.03, 0, 0), shell.points)
    assert np.minimum(local, 1.0 - local).min() >= NEAR
    facing = np.abs(shell.normals[:, 0]) == 1.0
    for level in (1.0 - INSET, 1.03 + INSET):
        assert np.isclose(shell.points[facing, 0], level, atol=0.002).any()


@pytest.mark.parametrize("wall", [0.3, 0.1])
def test_inset_hollow_body_stays_in_wall(wall: float) -> None:
    hollow = 1.0 - 2.0 * wall
    tool = together(box((1, 1, 1)), box((hollow, hollow, hollow), at=(wall, wall, wall)))
    shell = PointShell.from_mesh(*tool, 1000, inset=INSET)
    outer = np.minimum(shell.points, 1.0 - shell.points).min()
    beyond = np.maximum(np.abs(shell.points - 0.5) - hollow / 2.0, 0.0)
    inner = np.linalg.norm(beyond, axis=1).min()
    least = min(INSET, wall / 2.0)
    # At the box's corners the void's are farther away than its walls.
    assert min(outer, inner, shell.inset.min()) >= 0.97 * least
    assert np.median(shell.inset) == pytest.approx(least, rel=0.05)


@given(seed=st.integers(0, 2**32), n=st.integers(4, 30), share=st.floats(0.05, 0.9))
@example(seed=1, n=4, share=0.5)  # an edge below 8 degrees
@example(seed=152, n=4, share=0.5)  # samples that lie 4e-5 insets from the other side of an edge
@settings(max_examples=3, deadline=None)
def test_inset_random_convex_bodies_covered(seed: int, n: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    corners, faces = hull_of(rng.normal(size=(n, 3)) * rng.uniform(0.2, 1.0, 3))
    size = float(np.ptp(corners, axis=0).min())
    inset = share * size / 2.0
    shell = PointShell.from_mesh(corners, faces, 200, inset=inset, seed=seed)
    inside = plane_distances(shell.points, corners)
    # Nothing nearer to the surface than it says; what says less than the inset was kept.
    assert np.all(inside >= shell.inset * 0.97 - 1e-9)
    assert np.all(inside <= shell.inset * (1.0 + 1e-9) + 1e-12)
    assert shell.inset.max() <= inset * (1.0 + 1e-12)
    on_surface = PointShell.from_mesh(corners, faces, 2000, seed=seed)
    area = ConvexHull(corners).area
    covering = np.sqrt(2.0 * area / (np.sqrt(3.0) * 200))
    assert nearest_to(shell.points, on_surface.points).max() <= 2.0 * inset + 2.5 * covering


@pytest.mark.parametrize("degrees", [0.2, 3.0])
def test_inset_points_inside_sharp_wedge(degrees: float) -> None:
    """Near the edge the other side is nearer than any share of the inset."""
    corners, faces = wedge(degrees)
    shell = PointShell.from_mesh(corners, faces, 1000, inset=0.02)
    inside = plane_distances(shell.points, corners)
    assert np.all(inside >= shell.inset * 0.97 - 1e-9)


@pytest.mark.parametrize("sides", [(0.01, 0.01, 0.01), (0.2, 0.01, 0.01), (0.2, 0.2, 0.01)])
def test_inset_small_tools_point_count(
    sides: tuple[float, float, float],
) -> None:
    shell = PointShell.from_mesh(*box(sides), 50, inset=INSET)
    assert len(shell) == 50
    assert (np.minimum(shell.points, sides - shell.points) >= 0.003).all()


def test_inset_saved_with_shell(tmp_path: Path) -> None:
    shell = PointShell.from_mesh(*wedge(40.0), 100, inset=INSET)
    shell.save(tmp_path / "tool.npz")
    saved = PointShell.from_file(tmp_path / "tool.npz")
    assert np.array_equal(saved.inset, shell.inset)
    assert np.array_equal(pickle.loads(pickle.dumps(shell)).inset, shell.inset)  # noqa: S301
    assert not shell.inset.flags.writeable
    plain = PointShell(shell.points, shell.normals, shell.center)
    assert np.array_equal(plain.inset, np.zeros(100))


@pytest.mark.parametrize("inset", [-1.0, np.nan, np.inf])
def test_inset_bad_values(inset: float) -> None:
    with pytest.raises(UsageError, match="an inset of"):
        PointShell.from_mesh(*box((1, 1, 1)), 10, inset=inset)
    shell = PointShell.from_mesh(*box((1, 1, 1)), 10)
    for wrong in (np.full(10, inset), np.zeros(9)):
        with pytest.raises(UsageError, match="inset"):
            PointShell(shell.points, shell.normals, shell.center, inset=wrong)


def field_in_hole(points: Floats, radius: float) -> Floats:
    """Distance to a hole's wall, voxels, trilinear between exact ones at voxel centres.

    The hole runs along z, so that the field is the same at all heights.
    """
    low = np.floor(points[:, :2] - 0.5) + 0.5
    share = points[:, :2] - low
    found = np.zeros(len(points))
    for corner in itertools.product((0, 1), repeat=2):
        weight = np.abs(1 - np.array(corner) - share).prod(axis=1)
        found += weight * np.abs(radius - np.linalg.norm(low + corner, axis=1))
    return found


def free_clearance(shell: PointShell, radius: float) -> float:
    """Least radial clearance, voxels, with which no point is nearer to the wall than the onset."""
    return next(
        float(clearance)
        for clearance in np.arange(0.0, 3.0, 0.02)
        if field_in_hole(shell.points, radius + clearance).min() >= 1.5
    )


@pytest.mark.parametrize("radius", [6.0, 20.0])
def test_inset_peg_moves_in_close_hole(radius: float) -> None:
    # Lengths in voxels. The axis of peg and hole is that of the lattice: corners at its centre.
    corners, faces = cylinder(radius, 30.0, n=128)
    drawn, plain = (PointShell.from_mesh(corners, faces, 400, inset=d) for d in (1.5, 0.0))
    assert free_clearance(drawn, radius) <= 0.08
    assert free_clearance(plain, radius) >= 1.45
