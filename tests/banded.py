"""Objects of points with distances to them by brute force, for tests of resident cells."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from hapticdb import Grid
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.kernels.field.lattice import BEYOND, HALF_WIDTH, ROW_SIDE, VOXELS_A_STEP
from hapticdb.kernels.field.packing import pack
from hapticdb.store.base import Band, Rows, Store
from voxels import voxel_object

Points = NDArray[np.float64]


def steps_to(points: Points, low: NDArray[np.int64], side: int) -> NDArray[np.uint8]:
    """Stored distances (side^3,) from centres to the nearest of points; `low`: the first centre."""
    centres = low + np.argwhere(np.ones((side, side, side))) + 0.5
    least = np.full(len(centres), np.inf)
    for point in points:
        least = np.minimum(least, np.linalg.norm(centres - point, axis=1))
    steps = np.minimum(least, HALF_WIDTH) / VOXELS_A_STEP + 0.5
    return np.where(least > HALF_WIDTH, BEYOND, steps).astype(np.uint8)


def rows_of_points(points: Points, grid: Grid) -> Rows:
    """Rows, with distances, of points (n, 3) in voxels of the grid."""
    ijk = np.unique(np.floor(points).astype(np.int64), axis=0)
    without = rows_of_voxels(ijk, grid, "brick")
    bits = dict(zip(without.keys.tolist(), without.occupancy.reshape(-1, 64), strict=True))
    offsets = np.argwhere(np.ones((3, 3, 3))) - 1
    bricks = np.unique((8 * offsets[:, None] + (ijk & ~7)).reshape(-1, 3), axis=0)
    bricks = bricks[grid.contains(bricks)]
    found = {}
    for key, brick in zip((grid.encode(bricks) >> 9).tolist(), bricks, strict=True):
        near = points[(np.abs(points - brick - 4.0) < 4.0 + 2 * HALF_WIDTH).all(axis=1)]
        values = steps_to(near, brick - 1, ROW_SIDE)
        if (values != BEYOND).any():
            found[key] = values
    keys = np.array(sorted(found), dtype=np.int64)
    occupancy = b"".join(bytes(bits.get(key, bytes(64))) for key in keys.tolist())
    band = Band(*pack(np.stack([found[key] for key in keys.tolist()])))
    return Rows(keys, np.zeros_like(keys), np.frombuffer(occupancy, np.uint8), band)


def write_points(store: Store, points: Points, name: str = "points") -> int:
    """Write an object of points (n, 3), in voxels, with distances; returns its id."""
    record = voxel_object(store.grid, np.unique(np.floor(points).astype(np.int64), axis=0), name)
    return store.add(record, rows_of_points(points, store.grid))


def move_points(store: Store, object_id: int, points: Points) -> None:
    """Replace an object by points (n, 3), in voxels, in one transaction."""
    before = store.object(object_id)
    ijk = np.unique(np.floor(points).astype(np.int64), axis=0)
    after = voxel_object(store.grid, ijk, before.name)
    record = dataclasses.replace(
        before, voxels=after.voxels, bounds=after.bounds, digest=after.digest
    )
    store.replace(record, rows_of_points(points, store.grid))
