"""Cells that a tool may meet soon; the fetching process fetches them, most urgent first."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import CELL_BITS, Grid
from hapticdb.kernels.resident.cell_table import cells_ahead
from hapticdb.store.base import Keys

REACH_VOXELS = 500.0
"""Voxels a second that a hand may reach from rest: 1 m/s in voxels of 2 mm. A larger value fetches
more cells around a resting hand."""
SLACK_VOXELS = 1.0
"""Voxels that a wish may move until its cells are computed again. A larger value computes less
often and fetches a wider margin."""
MOST_CELLS_WANTED = 1 << 15
"""Greatest number of cells of one wish: the box around a faster or larger tool is cut at its far
ends. A larger value serves larger tools and takes more time."""
CELL = float(1 << CELL_BITS)
"""Voxels on a cell's edge."""

Floats = NDArray[np.float64]


class Motion(NamedTuple):
    """Place and motion of a loop's tool: metres and m/s, world frame.

    tool (3,): the shell's centre; handle (3,): target of that centre, set by the hand; velocity
    (3,): of the handle; radius: distance from the centre to the shell's farthest point.
    """

    tool: Floats
    handle: Floats
    velocity: Floats
    radius: float

    @classmethod
    def of_told(cls, told: NDArray[np.void]) -> "Motion":
        """Motion from a loop's report: told () of `kernels.records.TOLD`, which is not copied."""
        return cls(told["tool"], told["handle"], told["velocity"], float(told["radius"]))

    @classmethod
    def at_rest(cls, position: Floats) -> "Motion":
        """Motion of a single point that stays at a position (3,)."""
        return cls(position, position, np.zeros(3), 0.0)

    @property
    def is_finite(self) -> bool:
        """Whether all numbers are finite."""
        return all(bool(np.isfinite(part).all()) for part in self)


class Wish(NamedTuple):
    """Where a tool is and may soon be, in voxels of the grid.

    start, move (3,): the bounding sphere's centre, and its displacement to the hand's expected
    place; radius: of the sphere; margin: greatest distance of the sphere from that path.
    """

    start: Floats
    move: Floats
    radius: float
    margin: float

    @classmethod
    def of_motion(
        cls, grid: Grid, motion: Motion, lookahead: float, peak_speed: float
    ) -> "Wish | None":
        """Wish for a session's motion, or None if not all of its numbers are finite.

        The bounding sphere moves from the tool to the hand, and on with the hand's velocity for
        `lookahead` seconds. The margin is the greatest distance of the hand from this path after
        that time, at 1.5 times its recent `peak_speed` (m/s), or at `REACH_VOXELS` if that is more.
        """
        if not motion.is_finite:
            return None
        size = grid.voxel_size
        tool, handle, velocity, radius = motion
        margin = max(1.5 * peak_speed / size, REACH_VOXELS) * lookahead
        return cls(
            (tool - np.array(grid.origin)) / size,
            (handle - tool + velocity * lookahead) / size,
            radius / size,
            margin,
        )

    def is_near(self, other: "Wish") -> bool:
        """Whether the cells of this wish can be used for the other wish."""
        away = [
            *(self.start - other.start),
            *(self.start + self.move - other.start - other.move),
            self.radius + self.margin - other.radius - other.margin,
        ]
        return bool(max(map(abs, away)) <= SLACK_VOXELS)

    def cells(self, grid: Grid) -> tuple[Keys, Floats]:
        """Cells within reach, most urgent first, and their urgency in voxels.

        The urgency of a cell is the least distance between it and the moving sphere, plus the
        distance that the sphere moves until it is nearest.
        """
        n_cells = max(grid.side >> CELL_BITS, 1)
        reach = self.radius + self.margin + 2.0 * SLACK_VOXELS
        end = self.start + self.move
        low = np.floor((np.minimum(self.start, end) - reach) / CELL)
        high = np.floor((np.maximum(self.start, end) + reach) / CELL)
        first = np.clip(low, 0, n_cells).astype(np.int64)
        last = np.clip(high, -1, n_cells - 1).astype(np.int64)
        if (first > last).any():
            return np.empty(0, dtype=np.int64), np.empty(0)
        self._trim(first, last)
        room = int(np.prod(last - first + 1))
        keys, urgency = np.empty(room, dtype=np.int64), np.empty(room)
        margin = self.margin + 2.0 * SLACK_VOXELS
        count = cells_ahead(first, last, self.start, self.move, self.radius, margin, keys, urgency)
        order = np.argsort(urgency[:count], kind="stable")
        return keys[:count][order], urgency[:count][order]

    def _trim(self, first: Keys, last: Keys) -> None:
        """Cut a box of too many cells, first .. last, at its far ends; in place."""
        spans = last - first + 1
        while np.prod(spans) > MOST_CELLS_WANTED:
            axis = int(np.argmax(spans))
            middle = self.start[axis] / CELL
            if middle - first[axis] > last[axis] - middle:
                first[axis] += max(spans[axis] // 4, 1)
            else:
                last[axis] -= max(spans[axis] // 4, 1)
            spans = last - first + 1
