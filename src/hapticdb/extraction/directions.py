"""Candidate directions of straight pulls: axes, contact directions, random ones."""

from itertools import combinations

import numpy as np

from hapticdb.array_types import Floats

N_RANDOM = 40
"""Random directions. Larger: more oblique paths, a slower search."""
MOST_NORMALS = 5
"""Groups of contact normals, at most."""
ALIKE = 0.998
"""Cosine of two directions that count as one, 3.6 degrees at most. Larger: more directions."""
AGAINST = -0.2
"""Cosine of direction and contact normal below which the contact opposes the direction."""
AXES = np.concatenate([np.eye(3), -np.eye(3)])


def likely_directions(normals: Floats, own: Floats) -> Floats:
    """Unit directions (D, 3) of a part's own axes (n, 3), of its contacts, and of the world's axes.

    normals (C, 3) : unit normals of the contacts at the start, into the part. They give the means
    of their groups, the sum of these, and the cross products of two of them (a drawer slides along
    two walls). Own axes are exact; contact normals are not.
    """
    groups = grouped(normals)
    mean = groups.sum(axis=0, keepdims=True)
    crosses = [np.cross(a, b) for a, b in combinations(groups, 2)]
    along = np.array([sign * cross for cross in crosses for sign in (1.0, -1.0)]).reshape(-1, 3)
    return distinct(np.concatenate([own, -own, AXES, groups, mean, along]))


def candidate_directions(normals: Floats, own: Floats, seed: int) -> Floats:
    """Likely and random unit directions (D, 3), in the order of the share of opposing contacts."""
    random = np.random.default_rng(seed).normal(size=(N_RANDOM, 3))
    found = distinct(np.concatenate([likely_directions(normals, own), random]))
    # rounded, and a stable sort: of nearly equal shares the likely directions stay first
    return found[np.argsort(np.round(opposed_shares(found, normals), 2), kind="stable")]


def grouped(normals: Floats) -> Floats:
    """Mean unit normals (G, 3) of the largest groups of similar normals, largest group first."""
    if not len(normals):
        return np.empty((0, 3))
    # rounded to half units, similar normals share a cell
    cells, which, counts = np.unique(
        np.rint(2.0 * normals), axis=0, return_inverse=True, return_counts=True
    )
    sums = np.zeros(cells.shape)
    np.add.at(sums, which.reshape(-1), normals)
    largest = np.argsort(-counts, kind="stable")[:MOST_NORMALS]
    return distinct(sums[largest])


def distinct(directions: Floats) -> Floats:
    """Unit vectors (D, 3) of vectors (n, 3), without zeros and duplicates (`ALIKE`)."""
    lengths = np.linalg.norm(directions, axis=1)
    units = directions[lengths > 1e-6] / lengths[lengths > 1e-6, None]
    kept: list[Floats] = []
    # the first of similar ones stays: exact axes come before means of contact normals
    for unit in units:
        if all(float(unit @ other) < ALIKE for other in kept):
            kept.append(unit)
    return np.array(kept).reshape(-1, 3)


def opposed_shares(directions: Floats, normals: Floats) -> Floats:
    """Share (D,) of the contacts, 0 .. 1, opposed to each direction (D, 3)."""
    if not len(normals):
        return np.zeros(len(directions))
    return np.asarray((directions @ normals.T < AGAINST).mean(axis=1))
