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
class Source:
    """The objects and rows that are repeated, on a grid whose voxels the copies' grid continues."""

    grid: Grid
    layout: Layout
    parts: tuple[tuple[Object, Rows], ...]

    @property
    def voxels(self) -> int:
        """Object voxels of one copy."""
        return sum(obj.voxels for obj, _ in self.parts)

    @classmethod
    def of(cls, env: Environment) -> "Source":
        """All objects of an environment in Z-order that fits into memory, without distances."""
        parts = []
        for obj in env.objects():
            ranges = object_ranges(env.grid, env.layout, obj)
            parts.append((obj, env.store.rows_of(obj.id, *ranges)))
        return cls(env.grid, env.layout, tuple(parts))

    def within(self, voxels: float) -> "Source":
        """A source of the objects nearest to the middle that together have at most `voxels`."""
        middles = np.array([obj.bounds.mean(axis=0) for obj, _ in self.parts])
        distances = np.linalg.norm(middles - middles.mean(axis=0), axis=1)
        room = voxels
        chosen = []
        for n in np.argsort(distances, kind="stable"):
            if self.parts[n][0].voxels <= room:
                room -= self.parts[n][0].voxels
                chosen.append(int(n))
        return replace(self, parts=tuple(self.parts[n] for n in sorted(chosen)))


@dataclass(frozen=True)
class Plan:
    """Places of copies: `tiles` (C, 3), in edges of the source's grid, and the grid of all."""

    source: Source
    grid: Grid
    tiles: NDArray[np.int64]

    @classmethod
    def of(cls, source: Source, copies: int) -> "Plan":
        """Copies nearly in a square, in the order of their keys: rows are written ascending."""
        side = math.isqrt(copies - 1) + 1
        bits = source.grid.bits + (side - 1).bit_length()
        grid = replace(source.grid, bits=bits)
        numbers = np.arange(copies)
        tiles = np.stack([numbers % side, numbers // side, np.zeros_like(numbers)], axis=1)
        order = np.argsort(grid.encode(tiles * source.grid.side))
        return cls(source, grid, tiles[order])

    @property
    def voxels(self) -> int:
        """Object voxels of all copies."""
        return len(self.tiles) * self.source.voxels

    @property
    def middle(self) -> int:
        """Number of the copy nearest to the middle of all."""
        return int(np.argmin(np.linalg.norm(self.tiles - self.tiles.mean(axis=0), axis=1)))

    def offsets(self) -> NDArray[np.float64]:
        """Offset of each copy from the source, (C, 3) metres."""
        return self.tiles.astype(np.float64) * self.source.grid.edge

    def parts_of(self, copy: int) -> list[tuple[Object, Rows]]:
        """Objects and rows of one copy."""
        corner = self.tiles[copy] * self.source.grid.side
        key = self.grid.encode([corner]) >> row_shift(self.source.layout)
        offset = self.offsets()[copy]
        shift = np.eye(4)
        shift[:3, 3] = offset
        return [
            (
                replace(
                    obj,
                    id=0,
                    revision=0,
                    name=f"copy {copy}/{obj.name}",
                    transform=shift @ obj.transform,
                    bounds=obj.bounds + offset,
                ),
                Rows(rows.keys + key, rows.ids, rows.occupancy),
            )
            for obj, rows in self.source.parts
        ]


def write_copies(store: Store, plan: Plan) -> None:
    """Write all copies into an empty store on the plan's grid."""
    with store.loading():
        for copy in range(len(plan.tiles)):
            for obj, rows in plan.parts_of(copy):
                store.add(obj, rows)
    store.analyze(DEFAULT_RESOLUTION)
