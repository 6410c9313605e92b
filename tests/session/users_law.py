"""A user's law with a number that is shorter than an address before its array, in a session."""

from typing import Any, NamedTuple

import numpy as np

from hapticdb.kernels import force_law as kernels


class Numbers(NamedTuple):
    """An array begins at a multiple of 8 bytes, behind the truth value."""

    stiffness: float
    is_on: bool
    depths: Any


def respond(law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201, ARG001
    """Every hit is felt as deep as the array says, in voxels."""
    return law.depths[1] * size, 1.0


kernels.define(Numbers, kernels.Leaves(respond=respond))


class Table:
    """The same, as a session takes a law."""

    stiffness = 750.0
    for_kernels = Numbers(stiffness, True, np.array([np.nan, 0.5]))
