"""Voxels held in memory: a dense bitmap, sorted keys, a hash set.

The bitmap is the limit: every brick of the grid at the place of its key, 1 GiB at 11 bits an axis,
so that a lookup is a copy.
"""

import sys

import numpy as np

from hapticdb.store.base import BRICK_BYTES, BRICK_SHIFT, NO_OCCUPANCY, Keys
from peers import PeerWork
from peers.rows import Found, RowPeer


class DenseBitmap(RowPeer):
    """Every brick of the grid in memory, indexed by its key."""

    name = "dense bitmap"
    layout = "brick"

    def load(self, work: PeerWork) -> None:
        count = 1 << max(3 * work.env.grid.bits - BRICK_SHIFT, 0)
        self._bricks = np.zeros((count, BRICK_BYTES), dtype=np.uint8)
        self._bricks[work.bricks.keys] = work.bricks.occupancy
        # gathered into one place: no allocation a frame, and read-only for the kernels, whose
        # compiled form is one on every path
        gathered = bytearray(len(work.shell.points) * BRICK_BYTES)
        self._gathered = np.frombuffer(gathered, dtype=np.uint8).reshape(-1, BRICK_BYTES)
        self._read = np.frombuffer(memoryview(gathered).toreadonly(), dtype=np.uint8)

    def look_up(self, keys: Keys) -> Found:
        n = len(keys)
        np.take(self._bricks, keys, axis=0, out=self._gathered[:n], mode="clip")
        return keys, self._read[: n * BRICK_BYTES]

    def size(self) -> tuple[str, int]:
        return "memory", self._bricks.nbytes

    def close(self) -> None:
        del self._bricks


class SortedKeys(RowPeer):
    """All voxel keys in one sorted array, searched by halving."""

    name = "NumPy searchsorted"
    layout = "voxel"

    def load(self, work: PeerWork) -> None:
        self._keys = work.voxels

    def look_up(self, keys: Keys) -> Found:
        at = self._keys.searchsorted(keys)
        return keys[self._keys.take(at, mode="clip") == keys], NO_OCCUPANCY

    def size(self) -> tuple[str, int]:
        return "memory", self._keys.nbytes

    def close(self) -> None:
        del self._keys


class VoxelSet(RowPeer):
    """All voxel keys in a set of Python's integers."""

    name = "Python set"
    layout = "voxel"

    def load(self, work: PeerWork) -> None:
        self._keys = set(work.voxels.tolist())

    def look_up(self, keys: Keys) -> Found:
        known = self._keys
        found = [key for key in keys.tolist() if key in known]
        return np.array(found, dtype=np.int64), NO_OCCUPANCY

    def size(self) -> tuple[str, int]:
        return "memory", sys.getsizeof(self._keys) + len(self._keys) * sys.getsizeof(1 << 31)

    def close(self) -> None:
        del self._keys


PEERS = (DenseBitmap, SortedKeys, VoxelSet)
