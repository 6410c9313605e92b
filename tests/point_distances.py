"""Distances of many places from one surface: each is a pose of a single point."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces.triangle_bvh import TriangleBVH
from hapticdb.kernels.triangles.surface_distance import nearest
from hapticdb.pointshell.shape import bvh_of

Floats = NDArray[np.float64]


def distances_to(tree: TriangleBVH, places: Floats) -> Floats:
    """Distances (Q,) of places (Q, 3) to a tree's triangles."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    point = bvh_of(np.zeros((1, 3, 3)))
    return nearest(tree, point, poses, np.full(len(places), np.inf)).at_most
