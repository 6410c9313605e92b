"""Triangles cut into small pieces, each of which lies in a ball around its middle."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.pointshell.coverage import halves

Floats = NDArray[np.float64]


class Cut(NamedTuple):
    """P pieces of a surface.

    middles (P, 3), radii (P,): metres; a ball of that radius around the middle holds the piece;
    triangles (P, 3, 3): the pieces; sources (P,) int64: the triangle that each is cut from.
    """

    middles: Floats
    radii: Floats
    triangles: Floats
    sources: NDArray[np.int64]


def radii_of(triangles: Floats, middles: Floats) -> Floats:
    """Radii (P,) of the balls around the middles (P, 3) that hold triangles (P, 3, 3)."""
    return np.asarray(np.linalg.norm(triangles - middles[:, None], axis=2).max(axis=1))


def cut(triangles: Floats, goal: float, most: int) -> Cut | None:
    """Pieces with a radius of at most `goal`; None if they are more than `most`."""
    sources = np.arange(len(triangles))
    while True:
        middles = triangles.mean(axis=1)
        radii = radii_of(triangles, middles)
        is_large = radii > goal
        if not is_large.any():
            return Cut(middles, radii, triangles, sources)
        triangles = np.concatenate([triangles[~is_large], halves(triangles[is_large])])
        sources = np.concatenate([sources[~is_large], np.tile(sources[is_large], 2)])
        if len(triangles) > most:
            return None
