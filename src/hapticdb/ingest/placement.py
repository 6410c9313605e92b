"""Check of an object's transform, bounds and rows against its surface and the grid."""

from collections.abc import Iterator

import numpy as np

from hapticdb.errors import GridError
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.ingest.planning import bounds_inside
from hapticdb.mesh import Part
from hapticdb.store.base import Object, Store

SAMPLES = 1024
"""Most vertices of a surface, and most triangle centroids, tested against its object's voxels."""
ROUNDING = 1e-9
"""Tolerance of bounds from another machine, as a share of the greatest coordinate."""
INSIDE = 1e-4
"""Voxels: samples this near a voxel's side are skipped, as rounding may assign them to its
neighbour."""
OTHER_BOUNDS = "its bounds are not those of its surface at its transform"
"""Fault of an object with its rows at its surface, but with other bounds."""


def placement_faults(store: Store, obj: Object, part: Part) -> Iterator[str]:
    """Contradictions between an object and its placed surface: bounds, grid, rows."""
    if (obj.transform[3] != (0, 0, 0, 1)).any():
        yield "its transform is no placement"
        return
    try:
        bounds = bounds_inside(part, obj.link, store.grid, obj.transform)
    except GridError:
        yield "its surface lies outside the grid"
        return
    if not _is_where_rows_are(store, obj, part):
        yield "its rows are not where its surface is: its transform or the grid is another"
    slack = ROUNDING * float(max(np.abs(bounds).max(), np.abs(part.vertices).max()))
    if np.abs(bounds - obj.bounds).max() > slack:
        yield OTHER_BOUNDS


def _is_where_rows_are(store: Store, obj: Object, part: Part) -> bool:
    """Whether samples of a surface lie in voxels of its object."""
    points = part.world_points()
    samples = points[:: len(points) // SAMPLES + 1]
    if part.faces is not None:
        some = part.faces[:: len(part.faces) // SAMPLES + 1]
        samples = np.concatenate([samples, points[some].mean(axis=1)])
    scaled = store.grid.to_voxel_units(samples)
    scaled = scaled[(np.abs(scaled - np.round(scaled)) > INSIDE).all(axis=1)]
    if not len(scaled):
        return True
    wanted = rows_of_voxels(np.floor(scaled).astype(np.int64), store.grid, store.layout)
    found = store.rows_of(obj.id, wanted.keys, wanted.keys)
    if not np.array_equal(found.keys, wanted.keys):
        return False
    return bool((found.occupancy & wanted.occupancy == wanted.occupancy).all())
