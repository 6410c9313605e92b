"""Pictures: scenes are upright, the nearest triangle is seen; lengths are readable."""

import numpy as np
import pytest

import hapticdb
from hapticdb import Grid
from hapticdb.pictures.canvas import Canvas, turned
from hapticdb.store.attributes import AXES, up_axis
from hapticdb.units import length_text

BOX = np.array([[[0.0, 0.0, 0.0], [2.0, 3.0, 1.0]]])


def canvas(up: int = 2) -> Canvas:
    return Canvas(BOX, (200, 150), np.array([[10.0, 10.0], [190.0, 140.0]]), np.zeros(3), up)


def plate(height: float, slope: float = 0.0) -> np.ndarray:
    """Two triangles over the box, at a height over its middle; slope : rise to the left."""
    corners = np.array([[x, y, height + slope * (y - 1.5)] for x in (0, 2) for y in (0, 3)])
    return corners[[[0, 1, 2], [3, 2, 1]]]


@pytest.mark.parametrize("up", [0, 1, 2])
def test_canvas_up_axis(up: int) -> None:
    foot = np.array([1.0, 1.0, 1.0])
    (x0, y0, _), (x1, y1, _) = canvas(up).project(np.stack([foot, foot + np.eye(3)[up]]))
    assert y1 < y0  # pixel rows count downwards
    assert abs(x1 - x0) < 0.25 * (y0 - y1)
    axes = np.stack([turned((x, y, z), up) for x, y, z in np.eye(3).tolist()])
    assert np.linalg.det(axes) == pytest.approx(1.0)


@pytest.mark.parametrize("heights", [(0.2, 0.8), (0.8, 0.2)])
def test_canvas_nearer_triangle_visible(heights: tuple[float, float]) -> None:
    drawn = canvas()
    for height in heights:
        drawn.fill(plate(height), np.array([height, 0.0, 0.5]))
    column, row, _ = drawn.project(np.array([1.0, 1.5, 0.8])).astype(int)
    red, _, blue = np.asarray(drawn.picture())[row, column] / 255.0
    assert red / blue == pytest.approx(1.6, rel=0.02)
    assert np.asarray(drawn.picture())[0, 0].max() == 0


def test_canvas_brighter_towards_light() -> None:
    brightness = []
    for slope in (-0.3, 0.3):  # the light comes from the left, +y
        drawn = canvas()
        drawn.fill(plate(0.5, slope), np.full(3, 0.8))
        brightness.append(np.asarray(drawn.picture()).max())
    assert brightness[0] > brightness[1]


def test_canvas_fill_nothing_in_view() -> None:
    drawn = canvas()
    drawn.fill(plate(0.5) + np.array([100.0, 0.0, 0.0]), np.ones(3))
    drawn.fill(np.empty((0, 3, 3)), np.ones(3))
    assert np.asarray(drawn.picture()).max() == 0


def test_canvas_near_clipping() -> None:
    drawn = canvas()
    drawn.fill(plate(0.5) + 10.0 * turned((0.50, 0.76, 0.44), 2), np.ones(3))
    assert np.asarray(drawn.picture()).max() == 0


def test_up_axis_by_most_voxels() -> None:
    grid = Grid(0.1, (0, 0, 0), 4)

    def votes(*said: tuple[object, int]) -> str:
        return AXES[up_axis([
            hapticdb.Object("p", "a", "", np.eye(4), n, np.zeros((2, 3)),
                            {} if up is None else {"up": up})
            for up, n in said
        ])]  # fmt: skip

    assert grid.side == 16
    assert votes() == votes((None, 5)) == votes(("y", 3), (None, 3)) == "z"
    assert votes(("y", 4), ("z", 3)) == "y"
    assert votes(("x", 4)) == "x"
    assert votes((["y"], 4), ("north", 2)) == "z"


@pytest.mark.parametrize(
    ("length", "text"),
    [(12_500.0, "12.5 km"), (4_280.0, "4280 m"), (0.1274, "0.1274 m"), (0.0067, "6.7 mm"),
     (1e-5, "10 µm"), (0.0, "0 µm")],
)  # fmt: skip
def test_length_text_readable_unit(length: float, text: str) -> None:
    assert length_text(length) == text
