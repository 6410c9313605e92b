"""Kinds of pairs of surfaces, on constructed cases; lengths in millimetres."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb.clashes.judge import Judged, judge
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


def rod(radius: float, length: float, sections: int = 48) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius, length, sections=sections)


def plate(bore: float, sections: int) -> CollisionShape:
    """A ring of 4 mm, its bore along z."""
    return solid(trimesh.creation.annulus(bore, 10.0, 4.0, sections=sections))


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


@pytest.mark.parametrize("gap", [1e-6, 0.02, 0.3, 0.99])
def test_a_gap_is_told_to_a_millionth_of_a_millimetre(gap: float) -> None:
    found = judged(block((4, 4, 4)), block((4, 4, 4)), (4.0 + gap, 1.0, 0.5))
    assert found.kind == ("apart" if gap > 0.05 else "touching")
    assert found.at_least == pytest.approx(gap * MM, abs=1e-9)
    assert found.at_most == pytest.approx(gap * MM, abs=1e-9)


def test_what_is_farther_than_asked_is_far() -> None:
    assert judged(block((4, 4, 4)), block((4, 4, 4)), (5.1, 0, 0)).kind == "far"


@pytest.mark.parametrize("at", [(4, 0, 0), (4, 4, 0), (4, 4, 4), (3.96, 1, 1), (4, 0.5, 1.0)])
def test_flush_boxes_touch(at: tuple[float, float, float]) -> None:
    assert judged(block((4, 4, 4)), block((4, 4, 4)), at).kind == "touching"


@pytest.mark.parametrize(
    ("thick", "kind"),
    [(0.0, "touching"), (0.02, "touching"), (0.09, "touching"), (0.5, "overlapping")],
)
@pytest.mark.parametrize("sections", [24, 96])
def test_a_peg_overlaps_its_bore_by_half_of_what_it_is_too_thick(
    sections: int, thick: float, kind: str
) -> None:
    found = judged(plate(3.0, sections), solid(rod(3.0 + 0.5 * thick, 20.0, sections)))
    assert found.kind == kind
    if kind == "overlapping":
        assert 0.24 * MM <= found.at_least <= 0.25 * MM


def test_a_fine_peg_overlaps_the_facets_of_a_coarse_bore() -> None:
    """The bore of 24 facets is 0.026 mm narrower between its corners."""
    for thick, kind in ((0.0, "touching"), (0.5, "overlapping")):
        assert judged(plate(3.0, 24), solid(rod(3.0 + 0.5 * thick, 20.0, 96))).kind == kind


def test_an_overlap_is_bounded_from_both_sides() -> None:
    found = judged(block((4, 4, 4)), block((4, 4, 4)), (3.5, 1.2, 0.7))
    assert found.kind == "overlapping"
    assert 0.49 * MM <= found.at_least <= 0.5 * MM <= found.at_most <= 1.3 * MM
    np.testing.assert_allclose(found.on_a[0], [2.0 * MM - 0.5 * MM, 2.0 * MM], atol=0.6 * MM)


@pytest.mark.parametrize("at", [(2, 0, 0), (1, 0, 0), (2, 2, 0)])
def test_flush_profiles_overlap_along_one_another(at: tuple[float, float, float]) -> None:
    """Their sides lie in one plane, so no corner of one is inside the other."""
    found = judged(block((4, 4, 4)), block((4, 4, 4)), at)
    assert found.kind == "overlapping"
    assert found.at_least >= 0.3 * MM


def test_a_shell_in_a_shell_is_inside() -> None:
    outer, inner = (solid(trimesh.creation.icosphere(2, radius)) for radius in (10.0, 3.0))
    assert judged(outer, inner).kind == "inside"
    assert judged(outer, inner).at_least > 6.0 * MM
    assert judged(outer, inner, (12.0, 0, 0)).kind == "overlapping"


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


@pytest.mark.parametrize("scale", [0.2, 0.5, 2.0])
def test_fine_and_coarse_meshes_are_judged_alike(scale: float) -> None:
    fine = trimesh.creation.box((4, 4, 4)).subdivide_to_size(scale)
    for at, kind in (((4, 0, 0), "touching"), ((3.5, 1, 1), "overlapping"), ((4.3, 0, 0), "apart")):
        assert judged(solid(fine), block((4, 4, 4)), at).kind == kind
