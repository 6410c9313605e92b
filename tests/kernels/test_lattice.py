"""The band's lattice against plain arithmetic."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.kernels.field import lattice

UNIT = st.floats(0.0, 1.0)


@given(st.floats(0.0, 4.0))
def test_a_stored_distance_is_right_to_half_a_step(distance: float) -> None:
    step = lattice.step_of(distance)
    if distance > lattice.HALF_WIDTH:
        assert step == lattice.BEYOND
    else:
        assert 0 <= step <= lattice.STEPS
        error = step * lattice.VOXELS_A_STEP - distance
        assert abs(error) <= 0.5 * lattice.VOXELS_A_STEP * (1.0 + 1e-12)


@pytest.mark.parametrize(
    ("place", "side"),
    [(lattice.row_place, lattice.ROW_SIDE), (lattice.cell_place, lattice.CELL_SIDE)],
)
def test_centres_are_numbered_with_k_running_fastest(place, side) -> None:  # type: ignore[no-untyped-def]  # noqa: ANN001
    numbers = np.arange(side**3).reshape(side, side, side)
    for x, y, z in [(-1, -1, -1), (0, 3, 5), (side - 2, side - 2, side - 2), (2, -1, side - 2)]:
        assert place(x, y, z) == numbers[x + 1, y + 1, z + 1]


@given(st.lists(st.floats(-3.0, 3.0), min_size=4, max_size=4), UNIT, UNIT, UNIT)
def test_linear_fields_are_interpolated_exactly(
    f: list[float], x: float, y: float, z: float
) -> None:
    def at(i: float, j: float, k: float) -> float:
        return f[0] + f[1] * i + f[2] * j + f[3] * k

    corners = [at(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    assert lattice.trilinear(*corners, x, y, z) == pytest.approx(at(x, y, z), abs=1e-12)
