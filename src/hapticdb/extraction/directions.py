"""Directions in which a part may be pulled: axes, those that contacts suggest, random ones."""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

N_RANDOM = 40
"""Number of random directions. Larger: oblique ways are found more often, a slower search."""
MOST_NORMALS = 5
"""Greatest number of groups of contact normals whose directions are tried."""
ALIKE = 0.998
"""Cosine above which two directions are one: 3.6 degrees. Larger: more directions."""
AGAINST = -0.2
"""Cosine of direction and contact normal below which the contact is opposed to the direction."""
AXES = np.concatenate([np.eye(3), -np.eye(3)])


def likely_directions(normals: Floats, own: Floats) -> Floats:
    """Unit directions (D, 3) that a part's own axes (n, 3) and its contacts suggest, and the axes.

    normals (C, 3) : unit normals of the contacts at the start, into the part, so away from what
    blocks it. Of these: the groups, their mean, and the directions along two groups at once, as a
    drawer slides along its walls. A part's own axes are exact where those of contacts are not.
    """
    groups = grouped(normals)
    mean = groups.sum(axis=0, keepdims=True)
    crosses = [np.cross(a, b) for a, b in combinations(groups, 2)]
    along = np.array([sign * cross for cross in crosses for sign in (1.0, -1.0)]).reshape(-1, 3)
    return distinct(np.concatenate([own, -own, AXES, groups, mean, along]))


def candidate_directions(normals: Floats, own: Floats, seed: int) -> Floats:
    """Likely and random unit directions (D, 3), those that fewest contacts oppose first."""
    random = np.random.default_rng(seed).normal(size=(N_RANDOM, 3))
    found = distinct(np.concatenate([likely_directions(normals, own), random]))
    return found[np.argsort(np.round(opposed_shares(found, normals), 2), kind="stable")]


def grouped(normals: Floats) -> Floats:
    """Mean unit normals (G, 3) of the largest groups of like normals, the largest group first."""
    if not len(normals):
        return np.empty((0, 3))
    cells, which, counts = np.unique(
        np.rint(2.0 * normals), axis=0, return_inverse=True, return_counts=True
    )
    sums = np.zeros(cells.shape)
    np.add.at(sums, which.reshape(-1), normals)
    largest = np.argsort(-counts, kind="stable")[:MOST_NORMALS]
    return distinct(sums[largest])


def distinct(directions: Floats) -> Floats:
    """Unit vectors (D, 3) of vectors (n, 3), without zeros and without those like earlier ones."""
    lengths = np.linalg.norm(directions, axis=1)
    units = directions[lengths > 1e-6] / lengths[lengths > 1e-6, None]
    kept: list[Floats] = []
    for unit in units:
        if all(float(unit @ other) < ALIKE for other in kept):
            kept.append(unit)
    return np.array(kept).reshape(-1, 3)


def opposed_shares(directions: Floats, normals: Floats) -> Floats:
    """Share (D,) of the contacts, 0 .. 1, that each direction (D, 3) presses against."""
    if not len(normals):
        return np.zeros(len(directions))
    return np.asarray((directions @ normals.T < AGAINST).mean(axis=1))
