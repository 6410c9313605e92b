"""Scenes of voxels with a closed form, and reads and writes that many tests need."""

import time

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import CurveName, Grid
from hapticdb.ingest.geometry import packed_surface
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.mesh import Part
from hapticdb.store.base import BRICK_BYTES, Band, Layout, Object, Rows, Store

NOTICED_S = 10.0
"""Seconds to wait for a notification of a commit. A larger value only delays a test's failure."""
KINDS: list[tuple[Layout, CurveName]] = [
    ("voxel", "z"),
    ("voxel", "hilbert"),
    ("voxel", "lexicographic"),
    ("brick", "z"),
    ("brick", "hilbert"),
]
"""Every layout with every curve that it can have."""
EVERYWHERE = [np.array([bound], dtype=np.int64) for bound in (0, 2**62)]
"""Lows and highs of one range that holds every key."""


def write_voxels(
    store: Store, ijk: NDArray[np.int64], name: str = "voxels", rows: Rows | None = None
) -> int:
    """Write voxels (n, 3), or their rows, as an object of no file; returns its id."""
    surface = packed_surface(_cloud_of(store.grid, ijk))
    rows = rows_of_voxels(ijk, *kind(store)) if rows is None else rows
    return store.add(voxel_object(store.grid, ijk, name), rows, surface)


def _cloud_of(grid: Grid, ijk: NDArray[np.int64]) -> Part:
    """Geometry of an object made of voxels (n, 3): their centres."""
    centres = np.array(grid.origin) + grid.voxel_size * (ijk + 0.5)
    return Part("", centres, None, np.eye(4))


def voxel_object(grid: Grid, ijk: NDArray[np.int64], name: str = "voxels") -> Object:
    """Record of an object made of voxels (n, 3)."""
    cloud = _cloud_of(grid, ijk)
    return Object(
        name=name,
        link="made",
        digest=cloud.digest,
        transform=np.eye(4),
        voxels=len(ijk),
        bounds=cloud.bounds,
        attributes={"made": True},
    )


def floor_voxels(grid: Grid, depth: int = 8, width: int = 32) -> NDArray[np.int64]:
    """Voxels (n, 3) of a solid floor: its top is the plane between k = side/2 - 1 and side/2."""
    middle = grid.side // 2
    half = min(width // 2, middle)
    across = np.arange(middle - half, middle + half)
    down = np.arange(max(middle - depth, 0), middle)
    return np.stack(np.meshgrid(across, across, down, indexing="ij"), axis=-1).reshape(-1, 3)


def blob(seed: int, center: tuple[int, int, int], radius: int = 8) -> NDArray[np.int64]:
    """Distinct voxels (n, 3) around a centre: dense inside, random at the rim."""
    rng = np.random.default_rng(seed)
    span = np.arange(-radius, radius + 1)
    offsets = np.stack(np.meshgrid(span, span, span, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = np.linalg.norm(offsets, axis=1)
    inside = distance < rng.uniform(radius / 2, radius, len(offsets))
    found: NDArray[np.int64] = offsets[inside] + np.array(center)
    return found


def with_distances(ijk: NDArray[np.int64], grid: Grid, layout: Layout, seed: int = 0) -> Rows:
    """Rows of voxels (n, 3) and of the bricks around them, with made-up packed distances.

    A store never unpacks distances: any bytes will do.
    """
    rows = rows_of_voxels(ijk, grid, layout)
    steps = np.stack(np.meshgrid(*[[-4, 0, 4]] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    near = np.clip(ijk + steps, 0, grid.side - 1).reshape(-1, 3)
    keys = rows_of_voxels(np.unique(near, axis=0), grid, layout).keys
    occupancy = np.zeros((len(keys), BRICK_BYTES), np.uint8)
    occupancy[np.searchsorted(keys, rows.keys)] = rows.occupancy.reshape(-1, BRICK_BYTES)
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 120, len(keys))
    lengths[:2] = 1, 1000
    data = rng.integers(0, 256, int(lengths.sum()), dtype=np.uint8)
    ids = np.zeros(len(keys), np.int64)
    return Rows(keys, ids, occupancy.reshape(-1), Band(data, np.cumsum(lengths)))


def kind(store: Store) -> tuple[Grid, Layout]:
    """Grid and layout of a store, the arguments that make rows."""
    return store.grid, store.layout


def everything(store: Store) -> Rows:
    return store.scan(*EVERYWHERE)


def is_noticed(watcher: Store) -> bool:
    """Whether a commit is noticed in time; on a server its notification takes a moment."""
    deadline = time.monotonic() + NOTICED_S
    while not watcher.has_changed():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.0005)
    return True
