"""Environments with distances, made from triangles as an import makes them."""

from pathlib import Path

import numpy as np
import trimesh

import hapticdb
from hapticdb import Environment, Grid
from hapticdb.grid import CurveName
from hapticdb.ingest.layout import voxels_of_rows
from hapticdb.ingest.voxelizing import rows_of_part
from hapticdb.mesh import Part
from hapticdb.testing import voxel_object

VOXEL = 0.005
TOP = 0.001
"""Height of the slab's upper face, metres; not on a border of voxels."""


def box_part(
    name: str, extents: tuple[float, float, float], at: tuple[float, float, float]
) -> Part:
    """A closed box about a place, metres."""
    mesh = trimesh.creation.box(extents)
    placed = np.eye(4)
    placed[:3, 3] = at
    vertices = np.array(mesh.vertices, dtype=np.float64)
    return Part(name, vertices, np.array(mesh.faces, dtype=np.int64), placed)


def imported(url: str | Path, curve: CurveName = "z") -> Environment:
    """A slab with its top at z = `TOP`, a post through it and a box apart; ids 1 to 3."""
    env = hapticdb.create(url, Grid(VOXEL, (-0.16, -0.16, -0.16), 6, curve), distances=True)
    for part in (
        box_part("slab", (0.2, 0.2, 0.03), (0.0, 0.0, TOP - 0.015)),
        box_part("post", (0.031, 0.033, 0.1), (0.0521, 0.0, 0.0)),
        box_part("apart", (0.02, 0.02, 0.02), (-0.05, 0.06, 0.1)),
    ):
        rows, _ = rows_of_part(part, env.grid, "brick", distances=True)
        voxels = voxels_of_rows(rows, env.grid, "brick")
        env.store.add(voxel_object(env.grid, voxels, part.name), rows)
    return env
