"""Grids: metres <-> voxels <-> keys, grids made from options and bounds, refused values."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb import Grid
from hapticdb.errors import GridError, UsageError
from hapticdb.grid import CURVE_NAMES, ROOM, CurveName, GridOptions

BOUNDS = np.array([[-1.0, 0.5, 2.0], [3.0, 1.5, 4.0]])  # sides 4, 1 and 2 m
LONGEST = 4.0
CENTER = (1.0, 1.0, 3.0)


def center_of(grid: Grid) -> NDArray[np.float64]:
    middle: NDArray[np.float64] = grid.bounds.mean(axis=0)
    return middle


@given(
    ijk=st.lists(st.integers(0, 2**12 - 1), min_size=3, max_size=3),
    corner=st.lists(st.integers(-(2**12), 2**12), min_size=3, max_size=3),
    place=st.lists(st.integers(0, 255), min_size=3, max_size=3),
)
def test_voxels_of_half_open(ijk: list[int], corner: list[int], place: list[int]) -> None:
    """A point on a border belongs to the upper voxel. Sizes are exact in binary here."""
    size = 2.0**-8
    x, y, z = (size * c for c in corner)
    grid = Grid(size, (x, y, z), 12)
    low = np.array([grid.origin]) + size * np.array([ijk])
    assert grid.voxels_of(low).tolist() == [ijk]
    assert grid.voxels_of(low + size * np.array([place]) / 256).tolist() == [ijk]
    assert grid.voxels_of(low - size / 256).tolist() == [[v - 1 for v in ijk]]


@given(
    size=st.floats(1e-5, 10),
    origin=st.tuples(*[st.floats(-100, 100)] * 3),
    ijk=st.lists(st.integers(0, 2**10 - 1), min_size=3, max_size=3),
)
def test_centers_inside_their_voxels(
    size: float, origin: tuple[float, float, float], ijk: list[int]
) -> None:
    grid = Grid(size, origin, 10)
    assert grid.voxels_of(grid.centers([ijk])).tolist() == [ijk]


@pytest.mark.parametrize("bits", [1, 21])
@pytest.mark.parametrize("curve", CURVE_NAMES)
def test_encode_decode_outside_grid(curve: CurveName, bits: int) -> None:
    grid = Grid(1.0, (0, 0, 0), bits, curve)
    for axis, value in itertools.product(range(3), (-1, grid.side)):
        voxel = [0, 0, 0]
        voxel[axis] = value
        assert grid.contains(np.array([[0, 0, 0], voxel])).tolist() == [True, False]
        with pytest.raises(GridError, match="lies outside the grid"):
            grid.encode([[0, 0, 0], voxel])
    for key in (-1, 8**bits):
        if key < 2**63:
            with pytest.raises(GridError, match="outside the curve"):
                grid.decode([0, key])
    assert grid.encode(np.empty((0, 3))).shape == (0,)
    assert grid.decode([]).shape == (0, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, (0, 0, 0), 4), "voxel size 0.0 m"), ((math.nan, (0, 0, 0), 4), "voxel size nan"),
        ((math.inf, (0, 0, 0), 4), "voxel size inf"), ((1.0, (0, 0, 0), 0), "0 bits an axis"),
        ((1.0, (0, 0, 0), 22), "22 bits an axis"), ((1.0, (0, 0), 4), "three finite"),
        ((1.0, (0, math.nan, 0), 4), "three finite"), ((1e300, (1.79e308, 0, 0), 20), "far end"),
        ((1.0, (0, 0, 0), 4, "peano"), "choose one of"),
    ],
)  # fmt: skip
def test_grid_bad_arguments(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(GridError, match=message) as caught:
        Grid(*arguments)
    assert isinstance(caught.value, UsageError)


EACH: dict[str, list[Any]] = {
    "bits": [None, 1, 11, 21],
    "voxel_size": [None, 0.01],
    "extent": [None, 1.0, 3.0],
    "origin": [None, (-5.0, -4.0, -3.0)],
    "curve": [None, "hilbert"],
}
COMBINATIONS = [
    made
    for values in itertools.product(*EACH.values())
    for made in [dict(zip(EACH, values, strict=True))]
    if None in (made["bits"], made["voxel_size"], made["extent"])
]


def test_fit_all_combinations_of_options() -> None:
    for given_options in COMBINATIONS:
        grid = GridOptions(**given_options).fit(BOUNDS)
        bits, size, extent = (given_options[name] for name in ("bits", "voxel_size", "extent"))
        wanted = (extent or ROOM) * LONGEST
        assert grid.curve == (given_options["curve"] or "z")
        if given_options["origin"] is None:
            np.testing.assert_allclose(center_of(grid), CENTER, atol=1e-12 * max(grid.edge, 1))
        else:
            assert grid.origin == given_options["origin"]
        assert size in {None, grid.voxel_size}
        if size is None:
            assert grid.bits == (bits or 10)
            assert grid.edge == pytest.approx(wanted, rel=1e-15)
        elif bits is not None:
            assert grid.bits == bits
        else:
            assert grid.edge / 2 < wanted <= grid.edge * (1 + 1e-12)
        GridOptions(**given_options).check_matches(grid, BOUNDS)


def test_fit_voxel_size_too_small() -> None:
    with pytest.raises(GridError, match=r"needs 23 bits an axis .* the most is 21"):
        GridOptions(voxel_size=1e-6).fit(BOUNDS)
    finest = ROOM * LONGEST / 2**21
    assert GridOptions(voxel_size=finest * 1.0001).fit(BOUNDS).bits == 21


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bits": 8, "voxel_size": 0.01, "extent": 1.0}, "give two of them"),
        ({"extent": 0.0}, "extent 0.0"), ({"extent": math.nan}, "extent nan"),
        ({"bits": 22}, "22 bits"), ({"voxel_size": 0.0}, "voxel size 0.0"),
        ({"origin": (1.0, 2.0)}, "three coordinates"),
        ({"origin": (1.0, 2.0, math.inf)}, "three finite"), ({"curve": "peano"}, "choose one of"),
    ],
)  # fmt: skip
def test_grid_options_bad_values(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GridError, match=message):
        GridOptions(**options)


def test_fit_single_point_needs_voxel_size() -> None:
    point = np.array([[1.0, 2.0, 3.0]] * 2)
    for options in (GridOptions(), GridOptions(extent=1.6), GridOptions(bits=8)):
        with pytest.raises(GridError, match="single point: give --voxel-size"):
            options.fit(point)
    for options in (GridOptions(voxel_size=0.5), GridOptions(voxel_size=0.5, bits=4)):
        grid = options.fit(point)
        np.testing.assert_allclose(center_of(grid), point[0])
        assert grid.contains(grid.voxels_of(point)).all()


def test_fit_overflowing_bounds() -> None:
    with pytest.raises(GridError), np.errstate(all="ignore"):
        GridOptions().fit(np.array([[-1e308] * 3, [1e308] * 3]))


KNOWN = Grid(0.01, (-1.0, 0.0, 2.0), 9, "hilbert")


def test_check_matches_equal_options() -> None:
    options: tuple[dict[str, Any], ...] = (
        {},
        {"voxel_size": 0.1 * 0.1},  # the same length, rounded differently
        {"origin": [-1.0 - 1e-15, 1e-15, 2.0]},
        {"bits": 9, "voxel_size": 0.01, "origin": (-1.0, 0.0, 2.0), "curve": "hilbert"},
    )
    for one in options:
        GridOptions(**one).check_matches(KNOWN)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bits": 10, "curve": "z"}, "bits 10 instead of 9; curve z instead of hilbert"),
        ({"voxel_size": 0.0100001}, "voxel size 0.0100001 instead of 0.01"),
        ({"origin": (-1.0, 0.0, 2.001)}, r"origin \(-1.0, 0.0, 2.001\) instead of"),
    ],
)
def test_check_matches_names_differing_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GridError, match=f"another grid: .*{message}"):
        GridOptions(**options).check_matches(KNOWN)


def test_check_matches_extent_by_edge() -> None:
    grid = GridOptions(bits=11, extent=1.6).fit(BOUNDS)
    GridOptions(bits=11, extent=1.6).check_matches(grid, BOUNDS)
    with pytest.raises(GridError, match=r"extent 1\.7"):
        GridOptions(bits=11, extent=1.7).check_matches(grid, BOUNDS)
    GridOptions(extent=1.7).check_matches(grid)  # no bounds: not comparable
