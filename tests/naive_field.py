"""Plain twins of the field's kernels, and the quasi-static energy as one function."""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.field.lattice import CELL_SIDE, HALF_WIDTH, STEPS

Floats = NDArray[np.float64]


def bump(t: float) -> float:
    """Quadratic B-spline about 0."""
    t = abs(t)
    if t <= 0.5:
        return 0.75 - t * t
    return 0.5 * (1.5 - t) ** 2 if t <= 1.5 else 0.0


def slope_of_bump(t: float) -> float:
    if abs(t) <= 0.5:
        return -2.0 * t
    return -float(np.sign(t)) * (1.5 - abs(t)) if abs(t) <= 1.5 else 0.0


def value_at(values: NDArray[np.uint8], center: tuple[int, int, int]) -> float:
    """Distance stored at a centre (-1 to 32 on each axis) of a cell, voxels."""
    i, j, k = center
    return (
        min(int(values.reshape((CELL_SIDE,) * 3)[i + 1, j + 1, k + 1]), STEPS) * HALF_WIDTH / STEPS
    )


def spline(values: NDArray[np.uint8], point: Floats) -> tuple[float, Floats]:
    """Distance and gradient at a point in a cell, voxels, by all centres that reach it."""
    home = np.floor(point).astype(int)
    u, gradient = 0.0, np.zeros(3)
    for step in product((-1, 0, 1), repeat=3):
        center = home + step
        t = point - (center + 0.5)
        q = value_at(values, (int(center[0]), int(center[1]), int(center[2])))
        weights, slopes = [bump(x) for x in t], [slope_of_bump(x) for x in t]
        u += q * weights[0] * weights[1] * weights[2]
        gradient += q * np.array(
            [
                slopes[0] * weights[1] * weights[2],
                weights[0] * slopes[1] * weights[2],
                weights[0] * weights[1] * slopes[2],
            ]
        )
    return u, gradient


def capped(x: float, stiffness: float, cap: float) -> float:
    """psi: energy of a spring that pulls no harder than its cap."""
    stretch = cap / stiffness
    return 0.5 * stiffness * x * x if x <= stretch else cap * (x - 0.5 * stretch)
