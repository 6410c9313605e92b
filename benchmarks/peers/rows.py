"""What the peers share that are asked for rows by key: the frame's own kernels around a lookup."""

import ctypes
import gc
from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hapticdb import PointShell
from hapticdb.grid import Grid
from hapticdb.kernels.query import contact, refining
from hapticdb.query.law import TangentPlane
from hapticdb.store.base import NO_KEYS, NO_OCCUPANCY, Keys, Layout, row_shift
from peers import SAME, PeerWork, Pose

Occupancy = NDArray[np.uint8]
Found = tuple[Keys, Occupancy]
"""Row keys (R,) ascending, and 64 bytes of each brick (64 R,) or, of voxels, none."""


class RowPeer(ABC):
    """A peer that looks up rows by key."""

    name: str
    question = SAME
    layout: ClassVar[Layout]

    def build(self, work: PeerWork) -> None:
        self.place(work.env.grid, work.shell)
        self.load(work)

    def place(self, grid: Grid, shell: PointShell) -> None:
        """Keep what a frame needs besides the rows."""
        self.grid = grid
        self._shell = shell
        self._origin = np.array(grid.origin)
        self._curve = grid.bits, grid.curve_code, row_shift(self.layout)
        self._ids = np.ones(len(shell.points), dtype=np.int64)

    @abstractmethod
    def load(self, work: PeerWork) -> None:
        """Take the rows in."""

    @abstractmethod
    def look_up(self, keys: Keys) -> Found:
        """Rows of distinct ascending keys (U,), at least one, that are there."""

    @abstractmethod
    def size(self) -> tuple[str, int]:
        """Where the rows lie, and how many bytes they take."""

    @abstractmethod
    def close(self) -> None:
        """Give the rows back."""

    def felt(self, pose: Pose) -> tuple[int, NDArray[np.float64]]:
        """Count of hits, and wrench (6,)."""
        shell = self._shell
        size = self.grid.voxel_size
        placed, asked, keys = contact.locate(
            shell.points, shell.normals, shell.center, pose, self._origin, size, *self._curve
        )
        found, occupancy = self.look_up(keys) if len(keys) else (NO_KEYS, NO_OCCUPANCY)
        ids = self._ids[: len(found)]
        law = TangentPlane().for_kernels
        wrench, hits, *_ = refining.refine(
            placed, asked, keys, found, ids, occupancy, None, NO_KEYS, self._origin, size, law
        )
        return len(hits), wrench

    def frame(self, pose: Pose) -> int:
        return self.felt(pose)[0]


def resident_bytes() -> int:
    """Memory that this process holds now, without what others before have given back."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096
