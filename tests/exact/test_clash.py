"""Kinds of pairs of surfaces, on constructed cases; lengths in millimetres."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb.exact.clash import Judged, judge
from hapticdb.pointshell.shape import CollisionShape

Floats = NDArray[np.float64]

MM = 1e-3
WITHIN, CONTACT = 1.0 * MM, 0.05 * MM
TURNS = (np.eye(3), Rotation.from_euler("xyz", [0.3, -1.1, 0.7]).as_matrix())


def solid(mesh: trimesh.Trimesh) -> CollisionShape:
    return CollisionShape(MM * np.asarray(mesh.triangles, dtype=np.float64))


def block(
    size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0)
) -> CollisionShape:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(at)
    return solid(mesh)


def judged(
    a: CollisionShape, b: CollisionShape, at: tuple[float, float, float] = (0, 0, 0)
) -> Judged:
    """Judge a pair both ways round, and turned: its kind does not depend on it."""
    found = []
    for turn in TURNS:
        pose, back = np.eye(4), np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, MM * np.array(at)
        back[:3, :3], back[:3, 3] = turn.T, -turn.T @ pose[:3, 3]
        if turn is TURNS[0]:
            found += [judge(a, b, pose, WITHIN, CONTACT), judge(b, a, back, WITHIN, CONTACT)]
        else:  # both turned by the same
            turned = [CollisionShape(shape.tree.corners @ turn.T) for shape in (a, b)]
            shift = np.eye(4)
            shift[:3, 3] = turn @ (MM * np.array(at))
            found.append(judge(turned[0], turned[1], shift, WITHIN, CONTACT))
    assert len({one.kind for one in found}) == 1, found
    return found[0]


@pytest.mark.parametrize("gap", [1e-6, 0.02, 0.3, 0.99, 1.1])
def test_a_gap_is_told_to_a_millionth_of_a_millimetre(gap: float) -> None:
    found = judged(block((4, 4, 4)), block((4, 4, 4)), (4.0 + gap, 1.0, 0.5))
    assert found.kind == ("touching" if gap < 0.05 else "apart" if gap < 1.0 else "far")
    if found.kind == "far":
        return
    assert found.at_least == pytest.approx(gap * MM, abs=1e-9)
    assert found.at_most == pytest.approx(gap * MM, abs=1e-9)


@pytest.mark.parametrize("at", [(4, 0, 0), (4, 4, 0), (4, 4, 4), (3.96, 1, 1), (4, 0.5, 1.0)])
def test_flush_boxes_touch(at: tuple[float, float, float]) -> None:
    assert judged(block((4, 4, 4)), block((4, 4, 4)), at).kind == "touching"


def test_a_fine_peg_overlaps_the_facets_of_a_coarse_bore() -> None:
    """The bore of 24 facets is 0.026 mm narrower between its corners."""
    bore = solid(trimesh.creation.annulus(3.0, 10.0, 4.0, sections=24))
    for radius, kind in ((3.0, "touching"), (3.25, "overlapping")):
        assert (
            judged(bore, solid(trimesh.creation.cylinder(radius, 20.0, sections=96))).kind == kind
        )


def test_an_overlap_is_bounded_from_both_sides() -> None:
    found = judged(block((4, 4, 4)), block((4, 4, 4)), (3.5, 1.2, 0.7))
    assert found.kind == "overlapping"
    assert 0.49 * MM <= found.at_least <= 0.5 * MM <= found.at_most <= 1.3 * MM
    np.testing.assert_allclose(found.on_a[0], [2.0 * MM - 0.5 * MM, 2.0 * MM], atol=0.6 * MM)


def test_what_lies_flush_in_a_solid_is_inside() -> None:
    assert judged(block((8, 8, 8)), block((2, 2, 2)), (3, 3, 0)).kind == "inside"
    assert judged(block((8, 8, 8)), block((8, 8, 8))).kind == "inside"  # placed twice


def test_what_lies_in_a_hollow_is_not_inside() -> None:
    cavity = trimesh.creation.box((6, 6, 6))
    cavity.invert()
    hollow = solid(trimesh.util.concatenate([trimesh.creation.box((8, 8, 8)), cavity]))
    assert judged(hollow, block((5, 5, 5))).kind == "apart"
    assert judged(hollow, block((6, 6, 6))).kind == "touching"
    assert judged(hollow, block((0.5, 0.5, 0.5)), (3.5, 0, 0)).kind == "inside"


def test_one_piece_of_many_inside_is_inside() -> None:
    pieces = [trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))]
    pieces[1].apply_translation((20, 0, 0))
    both = solid(trimesh.util.concatenate(pieces))
    assert judged(block((8, 8, 8)), both, (-20, 0, 0)).kind == "inside"


def test_open_sheets() -> None:
    corners = [(-5, -5, 0), (5, -5, 0), (5, 5, 0), (-5, 5, 0)]
    sheet = trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)])
    flat = solid(sheet)
    assert judged(flat, block((2, 2, 2)), (0, 0, 1)).kind == "touching"
    assert judged(flat, block((2, 2, 2)), (0, 0, 1.3)).kind == "apart"
    assert judged(flat, block((2, 2, 2)), (0, 0, 0.98)).kind == "touching"
    found = judged(flat, block((2, 2, 2)), (0, 0, 0.7))
    assert found.kind == "overlapping"
    assert found.at_least == pytest.approx(0.3 * MM, abs=0.01 * MM)


@pytest.mark.parametrize("turn", TURNS)
def test_the_deepest_place_of_equal_shapes_is_in_both(turn: Floats) -> None:
    one, same = block((100, 20, 20)), block((100, 20, 20))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, MM * np.array([30.0, 8.0, 5.0])
    found, apart = (judge(one, other, pose, WITHIN, CONTACT) for other in (one, same))
    assert found.kind == "overlapping"
    np.testing.assert_array_equal(found.on_a, apart.on_a)
    half = MM * np.array([50.0, 10.0, 10.0]) + 1e-9
    assert (np.abs(found.on_a) <= half).all()
    assert (np.abs(pose[:3, :3].T @ (found.on_a - pose[:3, 3])) <= half).all()
