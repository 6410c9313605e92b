"""Kinds and depths of pairs that meet, against closed forms; lengths in millimetres."""

import numpy as np
import pytest

from contact_scenes import (
    CONTACT,
    MEETINGS,
    MM,
    Floats,
    Meeting,
    box,
    frame_of,
    grid,
    inverted,
    judged,
    placed,
    sheet,
)
from hapticdb.exact.clash import classify_pair
from hapticdb.pointshell.shape import CollisionShape

FRAMES = (0, 1, 2)
SCENES = {one.name: one for one in MEETINGS}
EXACT, RELATIVE = 0.02, 0.02
"""How far below the true depth the proved one may be, the greater of both."""


def check(one: Meeting, a: Floats, b: Floats) -> None:
    found = judged(a, b, one.contact)
    assert found.kind == one.kind
    if one.kind == "overlapping":
        slack = max(EXACT, RELATIVE * one.depth)
        assert one.depth - slack <= found.at_least <= one.depth + 0.011
        assert found.at_most >= found.at_least * (1.0 - 1e-6)


@pytest.mark.parametrize("seed", FRAMES)
@pytest.mark.parametrize("name", SCENES)
def test_classify_pair_kind_and_depth(name: str, seed: int) -> None:
    """The same in any frame, and both ways round."""
    one, frame = SCENES[name], frame_of(seed)
    a, b = placed(one.a, frame), placed(one.b, frame)
    check(one, a, b)
    check(one, b, a)


@pytest.mark.parametrize("name", [one.name for one in MEETINGS if "void" not in one.name])
def test_classify_pair_independent_of_winding(name: str) -> None:
    """Files hold bodies inside out; a void beside its body is told by its winding alone."""
    one = SCENES[name]
    check(one, inverted(one.a), one.b)
    check(one, one.a, inverted(one.b))


@pytest.mark.parametrize("gap", [1e-6, 0.02, 0.3, 0.99, 1.1])
def test_classify_pair_gap_precision(gap: float) -> None:
    found = judged(box((4, 4, 4)), box((4, 4, 4), (4.0 + gap, 1.0, 0.5)))
    assert found.kind == ("touching" if gap < CONTACT else "apart" if gap < 1.0 else "far")
    if found.kind != "far":
        assert [found.at_least, found.at_most] == pytest.approx([gap, gap], abs=1e-6)


@pytest.mark.parametrize("seed", FRAMES)
def test_classify_pair_deepest_point_in_both(seed: int) -> None:
    """One shape twice, and two equal ones."""
    one, same = (CollisionShape(MM * box((100, 20, 20))) for _ in range(2))
    pose = frame_of(seed)
    pose[:3, 3] = MM * np.array([30.0, 8.0, 5.0])
    found, apart = (classify_pair(one, other, pose, MM, MM * CONTACT) for other in (one, same))
    assert found.kind == "overlapping"
    np.testing.assert_array_equal(found.on_a, apart.on_a)
    half = MM * np.array([50.0, 10.0, 10.0]) + 1e-9
    assert (np.abs(found.on_a) <= half).all()
    assert (np.abs(pose[:3, :3].T @ (found.on_a - pose[:3, 3])) <= half).all()


RIB = (20.0, (0.0, 0.0, 2.0))
"""Side and middle of a rib that stands 8 deep through a skin at 0: 10 above its middle."""


@pytest.mark.parametrize("n", [1, 4, 16, 33])
@pytest.mark.parametrize("aside", [0.0, 0.001, 0.37, 15.0 / 16.0])
def test_classify_pair_crossing_sheets_overlap(n: int, aside: float) -> None:
    """Also where mesh lines coincide: how deep is not known where nothing is closed."""
    side, at = RIB
    rib = grid("x", side, max(n - 1, 1), (aside, at[1], at[2]))
    for a, b in ((rib, grid("z", 30.0, n)), (grid("z", 30.0, n), rib)):
        found = judged(a, b)
        assert found.kind == "overlapping"
        assert found.at_least == 0.0


@pytest.mark.parametrize("thick", [0.08, 0.5, 2.0])
@pytest.mark.parametrize("times", [0, 1, 2])
def test_classify_pair_open_rib_depth_independent_of_mesh(times: int, thick: float) -> None:
    """An open rib through a closed plate: half the plate's thickness, or unknown if thin."""
    plate = box((30, 30, thick))
    told = []
    for n in (1, 7, 16):
        for aside in (0.0, 0.37):
            found = judged(grid("x", 20.0, n, (aside, 0, 2.0)), quartered(plate, times))
            assert found.kind == "overlapping"
            told.append(found.at_least)
    expected = 0.5 * thick if 0.5 * thick > CONTACT else 0.0
    np.testing.assert_allclose(told, expected, atol=max(EXACT, RELATIVE * expected))


def quartered(triangles: Floats, times: int) -> Floats:
    """The same surface, each triangle cut into four so many times."""
    for _ in range(times):
        a, b, c = np.moveaxis(triangles, 1, 0)
        d, e, f = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        corners = [(a, d, f), (d, b, e), (f, e, c), (d, e, f)]
        triangles = np.concatenate([np.stack(one, axis=1) for one in corners])
    return triangles


@pytest.mark.parametrize("times", [0, 1, 3])
@pytest.mark.parametrize(("at", "depth"), [((9.5, 1.0, 0.7), 0.5), ((3.0, 2.0, 9.0), 1.0)])
def test_classify_pair_box_depth_independent_of_mesh(
    times: int, at: tuple[float, float, float], depth: float
) -> None:
    fine = quartered(box((10, 10, 10)), times)
    for a, b in ((fine, box((10, 10, 10), at)), (quartered(box((10, 10, 10), at), times), fine)):
        found = judged(a, b)
        assert found.kind == "overlapping"
        assert depth - EXACT <= found.at_least <= depth + 1e-6
        assert found.at_most >= found.at_least
        deep = [5.0 - np.abs(found.on_a / MM - middle).max() for middle in ((0, 0, 0), at)]
        assert max(deep) >= depth - EXACT  # at the place that is told


@pytest.mark.parametrize("times", [0, 1, 3])
def test_classify_pair_open_sheet_depth(times: int) -> None:
    """A sheet that ends 3 below the face of a cube, on its mesh lines and beside."""
    for n, aside in ((1, 0.0), (1, 0.21), (13, 0.0), (13, 0.21)):
        blade = grid("x", 6.0, n, (aside, 0.0, 10.0))
        found = judged(blade, quartered(box((20, 20, 20)), times))
        assert found.kind == "overlapping"
        assert 3.0 - 0.07 <= found.at_least <= 3.0 + 1e-6


def test_classify_pair_flush_sheets_touch() -> None:
    for n in (1, 5, 16):
        for at in ((0.0, 0.0, 0.0), (0.3, 0.2, 0.0), (0.0, 0.0, 0.03)):
            assert judged(grid("z", 20.0, n, at), grid("z", 30.0, n + 1)).kind == "touching"
    assert judged(sheet(10.0, 0.06), sheet(30.0)).kind == "apart"
