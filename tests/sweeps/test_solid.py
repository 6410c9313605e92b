"""Depths in closed bodies that overlap, and what is thick: against plain formulas of boxes."""

import itertools

import numpy as np
import pytest
import trimesh
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from bands import distance_to_triangle
from hapticdb.kernels.surfaces import nearest, sides
from hapticdb.pointshell.coverage import Interior
from hapticdb.pointshell.orientation import orient
from hapticdb.sweeps.core import is_near_core
from hapticdb.sweeps.pieces import cut
from hapticdb.sweeps.solid import Solid

Floats = NDArray[np.float64]

ROUND = 1e-6


def box(low: ArrayLike, high: ArrayLike) -> trimesh.Trimesh:
    made = trimesh.creation.box(np.subtract(high, low))
    made.apply_translation(0.5 * np.add(low, high))
    return made


def solid_of(*made: trimesh.Trimesh, goal: float) -> Solid:
    return Solid(orient(np.concatenate([np.array(one.triangles) for one in made])), goal)


# --- several bodies ------------------------------------------------------------------------------


def depth_in_union(place: Floats, lows: Floats, highs: Floats) -> float:
    """Distance from what no box holds, by the cells between all planes of the boxes' faces."""
    least = np.inf
    planes = [
        np.unique([*lows[:, axis], *highs[:, axis], -np.inf, np.inf]).tolist() for axis in range(3)
    ]
    for cell in itertools.product(*(itertools.pairwise(line) for line in planes)):
        low, high = np.array(cell).T
        if not ((lows <= low) & (high <= highs)).all(axis=1).any():
            gap = np.maximum(np.maximum(low - place, place - high), 0.0)
            least = min(least, float(np.linalg.norm(gap)))
    return least


corners = st.tuples(*[st.integers(0, 6)] * 3).map(lambda one: np.array(one, dtype=float))
edges = st.tuples(*[st.integers(1, 4)] * 3).map(lambda one: np.array(one, dtype=float))


@pytest.mark.long
@settings(max_examples=6, deadline=None)
@given(
    boxes=st.lists(st.tuples(corners, edges), min_size=1, max_size=4),
    shift=st.sampled_from([0.0, 0.013]),
    seed=st.integers(0, 99),
)
@example(  # pieces that two bodies hold, and that a third one crosses
    boxes=[
        (np.array([0.0, 3.0, 4.0]), np.array([4.0, 4.0, 2.0])),
        (np.array([2.0, 3.0, 2.0]), np.array([4.0, 4.0, 4.0])),
        (np.array([2.0, 3.0, 2.0]), np.array([4.0, 4.0, 4.0])),
        (np.array([6.0, 2.0, 6.0]), np.array([4.0, 3.0, 2.0])),
    ],
    shift=0.013,
    seed=0,
)
def test_depths_in_a_union_of_boxes_are_between_their_bounds(
    boxes: list[tuple[Floats, Floats]], shift: float, seed: int
) -> None:
    """Corners on a lattice: faces end flush, or cross, or coincide; shift: nearly so."""
    lows = np.array([low for low, _ in boxes]) + shift * np.arange(len(boxes))[:, None]
    highs = lows + np.array([edge for _, edge in boxes])
    solid = solid_of(*map(box, lows, highs), goal=0.5)
    places = np.random.default_rng(seed).uniform(lows.min(0), highs.max(0), (40, 3))
    exact = np.array([depth_in_union(place, lows, highs) for place in places])
    # boxes with a face in common on the same side are not closed without it
    assume(solid.is_closed)
    # a box that shares edges with another one that it overlaps counts as a void in it
    assume(all(sign > 0 for _, sign in Interior(solid.surface).bodies))
    low, high = solid.depths(places, 0.0)
    inside = exact > ROUND
    assert (solid.holds(places[inside])).all()
    assert (low[inside] <= exact[inside] + ROUND).all()
    assert (high[inside] >= exact[inside] - ROUND).all()
    sure = solid.pieces.middles[solid.is_sure]
    at_border = np.array([depth_in_union(place, lows, highs) for place in sure[::40]])
    assert at_border.max(initial=0.0) <= solid.unsure + ROUND


def test_flush_boxes_are_one_solid_to_the_last_piece() -> None:
    """A wall between two boxes, and faces in one plane, leave no doubt but at their edges."""
    solid = solid_of(
        box((0.0, 0.0, 0.0), (4.0, 4.0, 4.0)), box((4.0, 1.0, 0.0), (8.0, 3.0, 4.0)), goal=0.5
    )
    low, high = solid.depths(np.array([[4.02, 2.0, 2.0], [3.0, 2.0, 1.0], [4.0, 2.0, 2.0]]), 0.0)
    assert low[:2] == pytest.approx([1.0, 1.0], abs=0.2)
    assert high == pytest.approx([1.0, 1.0, 1.0], abs=0.2)  # on the wall, who holds is not known


def test_boxes_that_share_an_edge_are_bodies_of_their_own() -> None:
    """The wall between them is in both of them: it is no border."""
    solid = solid_of(
        box((1.0, 4.0, 4.0), (5.0, 7.0, 5.0)), box((0.0, 4.0, 4.0), (1.0, 7.0, 8.0)), goal=0.5
    )
    assert len(np.unique(solid.surface.bodies)) == 2
    low, high = solid.depths(np.array([[0.999, 5.5, 4.5]]), 0.0)
    assert low[0] <= 0.5 <= high[0] + ROUND
    assert low[0] > 0.3


def test_a_void_is_outside() -> None:
    solid = solid_of(
        box((0.0, 0.0, 0.0), (6.0, 6.0, 6.0)), box((2.0, 2.0, 2.0), (4.0, 4.0, 4.0)), goal=0.5
    )
    low, high = solid.depths(np.array([[1.0, 3.0, 3.0], [3.0, 3.0, 3.0]]), 0.0)
    assert low == pytest.approx([1.0, -1.0], abs=1e-2)
    assert high == pytest.approx([1.0, -1.0], abs=1e-2)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 40))
def test_the_tree_finds_the_least_distance_to_a_triangle(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    triangles, bodies = rng.normal(size=(n, 3, 3)), rng.integers(1, 4, n)
    places = rng.normal(size=(9, 3))
    each = np.stack([distance_to_triangle(places, one) for one in triangles])
    tree = sides.triangle_tree(triangles, bodies)
    assert nearest.distances_to(tree, places) == pytest.approx(each.min(axis=0))
    own = np.full(9, 2)
    others = np.where((bodies != 2)[:, None], each, 5.0).min(axis=0)
    found = nearest.distances_to_others(tree, places, own, np.zeros((9, 3)), -1.0, 5.0)
    assert found == pytest.approx(np.minimum(others, 5.0))
    near = nearest.distances_to(tree, places, 0.5)
    far = each.min(axis=0) > 0.5
    assert near[far] == pytest.approx(each.min(axis=0)[far])
    assert near[~far].max(initial=0.0) <= 0.5


# --- thickness -----------------------------------------------------------------------------------


def is_thick(solid: Solid, depth: float) -> bool:
    pieces = cut(solid.pieces.triangles, 0.4 * depth, 1_000_000)
    assert pieces is not None
    return is_near_core(solid, pieces._replace(sources=solid.pieces.sources[pieces.sources]), depth)


def prism(angle: float) -> trimesh.Trimesh:
    """An isosceles wedge, 10 long and 8 deep, with an edge of that angle (degrees)."""
    half = 8.0 * np.tan(np.radians(0.5 * angle))
    ends = [[x, y, z] for x in (0.0, 10.0) for y, z in ((0.0, 0.0), (8.0, half), (8.0, -half))]
    return trimesh.convex.convex_hull(np.array(ends))


@pytest.mark.parametrize("thickness, expected", [(1.9, False), (2.1, True), (6.0, True)])  # noqa: PT006
def test_a_plate_is_thick_from_twice_the_depth_on(thickness: float, *, expected: bool) -> None:
    plate = solid_of(box((0.0, 0.0, 0.0), (12.0, 12.0, thickness)), goal=0.5)
    assert is_thick(plate, 1.0) is expected


@pytest.mark.parametrize("angle, expected", [(20.0, False), (90.0, True)])  # noqa: PT006
def test_a_sharp_wedge_is_thin_and_a_blunt_one_thick(angle: float, *, expected: bool) -> None:
    assert is_thick(solid_of(prism(angle), goal=0.5), 1.0) is expected


def test_one_thin_fin_among_many_pieces_is_seen() -> None:
    """Less than a piece in a thousand is on the fin's end."""
    block = box((0.0, 0.0, 0.0), (40.0, 40.0, 8.0))
    assert is_thick(solid_of(block, goal=1.0), 1.0)
    high = box((20.0, 20.0, 6.0), (20.4, 20.4, 13.0))
    assert not is_thick(solid_of(block, high, goal=1.0), 1.0)
    low = box((20.0, 20.0, 6.0), (20.4, 20.4, 8.5))
    assert is_thick(solid_of(block, low, goal=1.0), 1.0)
