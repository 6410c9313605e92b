"""Finds the objects inside a closed tool at the start of its path.

While no surface of an object meets the tool's, an object inside stays inside, so one pose is enough
for the whole path.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.resident.cells import EMPTY_SLOT
from hapticdb.pointshell.coverage import Interior
from hapticdb.pointshell.shell import PointShell
from hapticdb.resident.residency import Residency
from hapticdb.sweeps.objects import pairs_in_voxels

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_CELLS = 1 << 18
"""Greatest number of cells in the tool's bounding box that are searched; with more cells the result
is unknown. Larger: larger tools, more time."""
CELL, BRICK = 32, 8
CELLS_AT_ONCE = 1024
"""Greatest number of cells made resident together. Larger: fewer fetches."""


def enclosed_ids(residency: Residency, shell: PointShell, pose: Floats) -> Ints | None:
    """Ids of objects with voxels inside the tool's closed bodies at a pose, ascending.

    A voxel is inside if its centre is inside by more than half a voxel. None if the result is not
    known: the bounding box has too many cells; or it holds an occupied brick, and either the
    covering radius or the surface of a closed shell is not known.
    """
    interior = None if shell.surface is None else Interior(shell.surface)
    if not (shell.is_closed if interior is None else interior):
        return np.empty(0, dtype=np.int64)
    cells = _cells_around(residency, shell, pose)
    if len(cells) > MOST_CELLS:
        return None
    search = None
    if interior is not None and shell.cover is not None:
        search = _Search(residency, shell, pose, interior, shell.cover)
    ids = [np.empty(0, dtype=np.int64)]
    at_once = min(CELLS_AT_ONCE, (residency.table.n_slots - 1) // 2)
    for at in range(0, len(cells), at_once):
        slots, corners = _bricks_of(residency, cells[at : at + at_once])
        if len(slots) and search is None:
            return None
        if len(slots) and search is not None:
            ids.append(search.ids_in(slots, corners))
    return np.unique(np.concatenate(ids))


def _cells_around(residency: Residency, shell: PointShell, pose: Floats) -> Ints:
    """Keys of the cells that the tool's bounding box meets at a pose, ascending.

    If there are more than `MOST_CELLS`, an array of `MOST_CELLS` + 1 zeros.
    """
    grid = residency.grid
    world = shell.points @ pose[:3, :3].T + pose[:3, 3]
    reach = shell.cover or 0.0
    low = (world.min(axis=0) - reach - grid.origin) / grid.voxel_size
    high = (world.max(axis=0) + reach - grid.origin) / grid.voxel_size
    if (high < 0.0).any() or (low >= grid.side).any():
        return np.empty(0, dtype=np.int64)
    first = np.clip(low, 0, grid.side - 1).astype(np.int64) // CELL
    last = np.clip(high, 0, grid.side - 1).astype(np.int64) // CELL
    if np.prod((last - first + 1).astype(float)) > MOST_CELLS:
        return np.zeros(MOST_CELLS + 1, dtype=np.int64)
    i, j, k = np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(first, last, strict=True)))
    return np.sort(((i << 32) | (j << 16) | k).ravel())


def _bricks_of(residency: Residency, cells: Ints) -> tuple[Ints, Ints]:
    """Make cells resident; returns the slot (B,) and least voxel (B, 3) of each occupied brick."""
    residency.make_resident(cells)
    slots = residency.slots_of(cells)
    filled = slots != EMPTY_SLOT
    cells, slots = cells[filled], slots[filled]
    masks = residency.table.cells.masks[slots]
    which, bit = np.nonzero((masks[:, None] >> np.arange(64, dtype=np.uint64)) & np.uint64(1))
    corner = np.stack([cells >> 32, (cells >> 16) & 0xFFFF, cells & 0xFFFF], axis=1)[which] * CELL
    return slots[which], corner + BRICK * np.stack([bit >> 4, (bit >> 2) & 3, bit & 3], axis=1)


class _Search:
    """Searches bricks for voxels inside the tool at a pose."""

    def __init__(
        self,
        residency: Residency,
        shell: PointShell,
        pose: Floats,
        interior: Interior,
        cover: float,
    ) -> None:
        from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second

        self._residency, self._pose, self._interior, self._cover = residency, pose, interior, cover
        self._points = cKDTree(shell.points)

    def ids_in(self, slots: Ints, corners: Ints) -> Ints:
        """Ids of objects in voxels inside the tool; bricks with slots (B,), least voxels (B, 3)."""
        size = self._residency.grid.voxel_size
        middles = self._local(corners + 0.5 * BRICK)
        distances, _ = self._points.query(middles)
        half = 0.5 * np.sqrt(3.0) * BRICK * size
        is_clear = distances > self._cover + half
        is_inside = np.zeros(len(slots), dtype=bool)
        is_inside[is_clear] = self._interior.holds(middles[is_clear])
        whole = self._voxels(slots[is_inside], corners[is_inside])
        parts = self._voxels(slots[~is_clear], corners[~is_clear])
        centers = self._local(parts + 0.5)
        apart = self._points.query(centers)[0] > self._cover + 0.5 * size
        parts, centers = parts[apart], centers[apart]
        inside = np.concatenate([whole, parts[self._interior.holds(centers)]])
        if not len(inside):
            return np.empty(0, dtype=np.int64)
        store, exclude = self._residency.store, self._residency.exclude
        return np.unique(pairs_in_voxels(store, inside, exclude).ids)

    def _local(self, places: NDArray[np.floating]) -> Floats:
        """Convert places (n, 3) from voxels to metres in the tool's frame."""
        grid, pose = self._residency.grid, self._pose
        world = places * grid.voxel_size + np.asarray(grid.origin)
        return np.asarray((world - pose[:3, 3]) @ pose[:3, :3])

    def _voxels(self, slots: Ints, corners: Ints) -> Ints:
        """Occupied voxels (V, 3) of bricks (B,)."""
        across = np.arange(BRICK)
        i, j = corners[:, 0] % CELL, corners[:, 1] % CELL
        rows = (i[:, None, None] + across[:, None]) * CELL + j[:, None, None] + across
        words = self._residency.table.cells.words[slots[:, None, None], rows]
        shifts = (corners[:, 2] % CELL)[:, None, None, None] + across
        which, a, b, c = np.nonzero((words[..., None] >> shifts.astype(np.uint32)) & 1)
        return corners[which] + np.stack([a, b, c], axis=1)
