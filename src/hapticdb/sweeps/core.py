"""The core of a solid: what lies deeper below its border than two surfaces ever are in one another.

Let neither surface ever be deeper than d in the other solid, and let the core be the places of one
solid that are more than d below its border. Then the other surface never meets the core: a place of
it that did would be deeper than d. So the core, which is the solid made smaller by d on all sides,
comes out without touching the other surface at all.

That says little of what is too thin to have a core. A sheet thinner than 2 d may pass through
another one, and no place is ever deeper than d. So it is proved of one of the two that its surface
is nowhere far from its core, wherever the other surface comes near: within `FAR` times d.

An edge is always thin. The core of a wedge of the angle a begins d / sin(a / 2) from its edge, of a
cube 1.73 d from its corner. So edges sharper than about 40 degrees are not proved, nor is a fin
that stands out farther than twice d.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.sweeps.pieces import Cut
from hapticdb.sweeps.solid import Solid

Floats = NDArray[np.float64]

FAR = 3.0
"""Depths: greatest distance from the core at which a solid counts as thick. Larger: sharper edges
and higher fins are proved, and the statement is weaker."""
BELOW = 1.01
"""Depths below the border at which places of the core are looked for. Larger: plates have to be
thicker."""
BEGIN = 0.25
"""Depths below a piece where the search begins. Larger: fewer steps, and thin parts are passed."""
STEPS = 16
"""Steps of a search at most. Larger: more sharp edges are proved, in more time."""
APART = 0.5
"""Depths between the places at which the first searches begin. Larger: fewer searches, and more of
them in the second round."""
AT_ONCE = 256
"""Places of the second round that are searched together. Larger: fewer calls, and what is thin is
noticed later."""


def is_near_core(solid: Solid, pieces: Cut, depth: float) -> bool:
    """Whether every place of pieces is proved to be within `FAR` depths of the solid's core.

    Each place of the core that counts is inside, with a lower bound of its depth above `depth`. A
    place of a piece is as far from it as the piece's middle, and the piece's radius, at most.
    """
    if not solid.is_closed:
        return False
    if not len(pieces.radii):
        return True
    reach = FAR * depth - pieces.radii
    if (reach <= 0.0).any():
        return False
    normals = solid.surface.normals[pieces.sources]
    begin = _spread(pieces.middles, APART * depth)
    core = _searched(solid, pieces.middles[begin], normals[begin], depth)
    waiting = np.flatnonzero(_far(core, pieces.middles, reach))
    for at in range(0, len(waiting), AT_ONCE):  # each by itself, until one is not near
        some = waiting[at : at + AT_ONCE]
        core = _searched(solid, pieces.middles[some], normals[some], depth)
        if _far(core, pieces.middles[some], reach[some]).any():
            return False
    return True


def _spread(places: Floats, spacing: float) -> NDArray[np.int64]:
    """Numbers of places (n, 3), one for each cube of that edge."""
    cubes = np.floor((places - places.min(axis=0)) / spacing).astype(np.int64)
    return np.asarray(np.unique(cubes, axis=0, return_index=True)[1])


def _far(core: Floats, middles: Floats, reach: Floats) -> NDArray[np.bool_]:
    """Whether middles (n, 3) are farther than their reach (n,) from all places (m, 3)."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second

    if not len(core):
        return np.ones(len(middles), dtype=bool)
    return np.asarray(np.asarray(cKDTree(core).query(middles)[0]) > reach)


def _searched(solid: Solid, middles: Floats, normals: Floats, depth: float) -> Floats:
    """Places (m, 3) of the core, found from middles (n, 3) of pieces by going away from the border.

    A step is shorter than the distance from the border, so it does not pass it.
    """
    places = middles + BEGIN * depth * normals
    apart = solid.distances(places, 0.0)
    for _ in range(STEPS):
        rising = np.flatnonzero(apart < BELOW * depth)
        if not len(rising):
            break
        here, away = places[rising], apart[rising]
        slope = np.stack(
            [
                solid.distances(here + step, 0.0) - solid.distances(here - step, 0.0)
                for step in 1e-3 * depth * np.eye(3)
            ],
            axis=1,
        )
        steep = np.linalg.norm(slope, axis=1)
        step = np.minimum(BELOW * (1.0 + 1e-6) * depth - away, 0.9 * away)
        places[rising] += (step / np.maximum(steep, 1e-300))[:, None] * slope
        apart[rising] = solid.distances(places[rising], 0.0)
    below = places[(apart > depth) & (np.linalg.norm(places - middles, axis=1) < FAR * depth)]
    return np.asarray(below[solid.depths(below, 0.0)[0] > depth])
