"""Copies of all objects make an environment larger: their rows are repeated under other keys.

In Z-order the leading bits of a key name the cube that holds the voxel. A copy that is moved by
2^bits voxels therefore has the same keys except for the leading bits, and the same bricks: no
triangle is voxelized again. Copies lie side by side on a plane, like parked cars.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hapticdb import Environment
from hapticdb.grid import Grid
from hapticdb.paper.quantiles import DEFAULT_RESOLUTION
from hapticdb.store.base import Layout, Object, Rows, Store, row_shift
from hapticdb.store.covering import object_ranges


@dataclass(frozen=True)
class Copies:
    """Objects and their rows, and places of their copies.

    home : grid of the objects, whose voxels `grid`, that of all copies, continues; tiles (C, 3):
    places in edges of `home`.
    """

    home: Grid
    layout: Layout
    parts: tuple[tuple[Object, Rows], ...]
    grid: Grid
    tiles: NDArray[np.int64]

    @classmethod
    def of(cls, env: Environment) -> "Copies":
        """One copy: an environment in Z-order that fits into memory, without distances."""
        objects = [(obj, object_ranges(env.grid, env.layout, obj)) for obj in env.objects()]
        parts = tuple((obj, env.store.rows_of(obj.id, *ranges)) for obj, ranges in objects)
        return cls(env.grid, env.layout, parts, env.grid, np.zeros((1, 3), np.int64))

    def within(self, voxels: float) -> "Copies":
        """With the objects nearest to the middle that together have at most `voxels`."""
        middles = np.array([obj.bounds.mean(axis=0) for obj, _ in self.parts])
        distances = np.linalg.norm(middles - middles.mean(axis=0), axis=1)
        room, chosen = voxels, []
        for n in np.argsort(distances, kind="stable"):
            if self.parts[n][0].voxels <= room:
                room -= self.parts[n][0].voxels
                chosen.append(int(n))
        return replace(self, parts=tuple(self.parts[n] for n in sorted(chosen)))

    def times(self, count: int) -> "Copies":
        """Copies nearly in a square, in the order of their keys: rows are written ascending."""
        side = math.isqrt(count - 1) + 1
        grid = replace(self.home, bits=self.home.bits + (side - 1).bit_length())
        numbers = np.arange(count)
        tiles = np.stack([numbers % side, numbers // side, np.zeros_like(numbers)], axis=1)
        order = np.argsort(grid.encode(tiles * self.home.side))
        return replace(self, grid=grid, tiles=tiles[order])

    @property
    def voxels(self) -> int:
        """Object voxels of all copies."""
        return len(self.tiles) * sum(obj.voxels for obj, _ in self.parts)

    @property
    def middle(self) -> int:
        """Number of the copy nearest to the middle of all."""
        return int(np.argmin(np.linalg.norm(self.tiles - self.tiles.mean(axis=0), axis=1)))

    def offsets(self) -> NDArray[np.float64]:
        """Offset of each copy from the original, (C, 3) metres."""
        return self.tiles.astype(np.float64) * self.home.edge

    def write(self, store: Store) -> None:
        """Write all copies into an empty store on their grid."""
        with store.loading():
            for copy, offset in enumerate(self.offsets()):
                corner = self.tiles[copy] * self.home.side
                key = self.grid.encode([corner]) >> row_shift(self.layout)
                shift = np.eye(4)
                shift[:3, 3] = offset
                for obj, rows in self.parts:
                    name, place = f"copy {copy}/{obj.name}", shift @ obj.transform
                    moved = replace(
                        obj,
                        id=0,
                        revision=0,
                        name=name,
                        transform=place,
                        bounds=obj.bounds + offset,
                    )
                    store.add(moved, Rows(rows.keys + key, rows.ids, rows.occupancy))
        store.analyze(DEFAULT_RESOLUTION)
