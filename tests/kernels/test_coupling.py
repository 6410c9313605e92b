"""Leaves of the coupling, with the JIT on or off."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticdb.kernels.hand import anchors, coupling
from hapticdb.kernels.resident.cells import UNKNOWN

STEP = st.integers(-1, 1)
NUMBER = st.floats(-10.0, 10.0)
VECTOR = st.tuples(NUMBER, NUMBER, NUMBER)
ONE_CELL = (
    np.zeros((3, 2), dtype=np.int64),  # keys: only the cell at the origin
    np.ones((3, 2), dtype=np.int32),
    np.zeros((2, 1024), dtype=np.uint32),
)
ONE_CELL[0][:, 1] = -1


def a_cell(*occupied: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arrays of a cell table with one resident cell, at the grid's origin."""
    keys, slots, words = (array.copy() for array in ONE_CELL)
    for i, j, k in occupied:
        words[1, (i << 5) | j] |= np.uint32(1 << k)
    return keys, slots, words


SHEET = [(i, j, 8) for i in range(16) for j in range(16)]


@given(offset=st.tuples(STEP, STEP, STEP), voxel=st.tuples(*[st.integers(-1, 2**21)] * 3))
@settings(deadline=None)  # the first call compiles
def test_an_anchor_is_found_again_from_its_code(
    offset: tuple[int, int, int], voxel: tuple[int, int, int]
) -> None:
    code = anchors.anchor_code(*offset)
    assert 0 <= code < 27
    assert anchors.anchor_of(code, *voxel) == tuple(np.add(voxel, offset))


@given(start=st.tuples(STEP, STEP), steps=st.lists(st.tuples(STEP, STEP, STEP), max_size=40))
@settings(deadline=None)  # the first call compiles
def test_an_anchor_never_changes_sides(
    start: tuple[int, int], steps: list[tuple[int, int, int]]
) -> None:
    """The walk begins above a sheet and makes every step that is allowed."""
    cells = a_cell(*SHEET)
    at = np.array([8, 8, 8])
    anchor = np.array([8 + start[0], 8 + start[1], 9])
    for step in steps:
        then = at + step
        if (then[:2] < 1).any() or (then[:2] > 14).any():
            continue
        if anchors.may_enter(*cells, 0, 32, *anchor, *then) != 1:
            continue
        code = anchors.follow(*cells, 0, 32, *anchor, *then)
        assert code != anchors.NO_ANCHOR
        at, anchor = then, np.array(anchors.anchor_of(code, *then))
        assert at[2] >= 8
        assert anchor[2] > 8
        assert np.abs(at - anchor).max() <= 1


def test_outward_is_straight_up_from_a_sheet() -> None:
    cells = a_cell(*SHEET)
    assert anchors.outward(*cells, 0, 32, 8, 8, 9, 8, 8, 8) == (0.0, 0.0, 1.0)
    assert anchors.outward(*cells, 0, 32, 8, 8, 7, 8, 8, 8) == (0.0, 0.0, -1.0)


def test_what_is_unknown_is_neither_free_nor_occupied() -> None:
    cells = a_cell((31, 8, 8))
    assert anchors.state_of(*cells, 0, 64, 31, 8, 8) == 1
    assert anchors.state_of(*cells, 0, 64, 30, 8, 8) == 0
    assert anchors.state_of(*cells, 0, 64, 32, 8, 8) == UNKNOWN
    assert anchors.state_of(*cells, 0, 64, 64, 8, 8) == 0  # outside the grid
    assert anchors.may_enter(*cells, 0, 64, 30, 8, 8, 32, 8, 8) == UNKNOWN


@given(lever=VECTOR, moving=VECTOR, turning=VECTOR, direction=VECTOR, slimness=st.floats(0.0, 10.0))
@settings(deadline=None)  # the first call compiles
def test_an_impulse_stops_a_point_and_never_adds_energy(
    lever: tuple[float, float, float],
    moving: tuple[float, float, float],
    turning: tuple[float, float, float],
    direction: tuple[float, float, float],
    slimness: float,
) -> None:
    length = math.hypot(*direction)
    if length < 1e-3:
        return
    along = np.array(direction) / length
    mass = 0.5
    after = np.array([*moving, *turning])
    coupling.stop_along(*along, *lever, 1.0 / mass, slimness, after)
    speed = (after[:3] + np.cross(after[3:], lever)) @ along
    before = (np.array(moving) + np.cross(turning, lever)) @ along
    assert speed == pytest.approx(max(before, 0.0), abs=1e-9)
    if slimness > 1e-3:
        energy = mass * (after[:3] @ after[:3]) + (after[3:] @ after[3:]) / slimness
        first = mass * np.dot(moving, moving) + np.dot(turning, turning) / slimness
        assert energy <= first * (1 + 1e-9) + 1e-9


@given(speed=st.floats(0.0, 100.0), acceleration=st.floats(0.0, 1e6), way=st.floats(1e-5, 1e-1))
@settings(deadline=None)  # the first call compiles
def test_the_longest_step_goes_just_that_way(speed: float, acceleration: float, way: float) -> None:
    step = coupling.longest_step(speed, acceleration, way)
    if speed + acceleration > 1e-6:
        assert speed * step + acceleration * step**2 == pytest.approx(way)
