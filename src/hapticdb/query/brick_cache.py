"""Decoded bricks in the memory of this process, up to `store.base.DECODED_BYTES`."""

from collections.abc import Mapping
from weakref import ref

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.query import brick_frames as kernels
from hapticdb.kernels.query import shell_keys
from hapticdb.kernels.records.rows import BRICK, ENTRIES_A_ROW, MEASURED, OCCUPIED
from hapticdb.store.base import (
    BRICK_SHIFT,
    NO_DISTANCES,
    NO_KEYS,
    Keys,
    Object,
    Rows,
)
from hapticdb.store.parsing import damaged

LEAST_ENTRIES = 1 << 10
"""Entries of the smallest directory. It grows with the bricks: first writes to pages here and there
in a large table would cost a first visit more than its keys."""
MOST_FRAMES = 256
"""Frames after which dead weak references are dropped."""

Records = NDArray[np.void]
LocatedRows = tuple["shell_keys.Located", Rows, NDArray[np.uint8] | None]
"""A located shell, the rows of its keys, and their distances (R, 1000) if they are read."""


class CachedRows:
    """Rows of one frame's bricks: resident ones, and copies once these are dropped.

    placed, addresses : outputs of the frame's kernel.
    """

    __slots__ = ("__weakref__", "_addresses", "_bricks", "_copies", "_placed")

    def __init__(
        self,
        bricks: tuple[Records, Records],
        placed: NDArray[np.float64],
        addresses: NDArray[np.int64],
    ) -> None:
        self._bricks: tuple[Records, Records] | None = bricks
        self._placed, self._addresses = placed, addresses

    def __call__(self, reads: bool) -> LocatedRows:  # noqa: FBT001 - whether distances are read
        """The located shell with rows of all its keys."""
        located, rows, distances = self.copied()
        return located, rows, distances if reads else None

    def copied(self) -> LocatedRows:
        """Copy the rows, once."""
        if self._bricks is None:
            return self._copies
        directory, decoded = self._bricks
        keys_of_points, at = self._addresses
        points = np.flatnonzero(at >= 0)
        keys, where = np.unique(keys_of_points[points] >> BRICK_SHIFT, return_index=True)
        entries = directory[at[points[where]]]
        lengths = (entries["end"] - entries["first"]).astype(np.int64)
        ends = np.cumsum(lengths)
        slots = np.arange(lengths.sum()) + np.repeat(entries["first"] - (ends - lengths), lengths)
        bits = decoded["occupancy"][slots].reshape(-1)
        bits.flags.writeable = False
        rows = Rows(np.repeat(keys, lengths), decoded["id"][slots], bits)
        numbers = np.full_like(at, -1)
        numbers[points] = np.searchsorted(keys, keys_of_points[points] >> BRICK_SHIFT)
        located = shell_keys.Located(self._placed, np.stack([keys_of_points, numbers]), keys)
        self._copies: LocatedRows = located, rows, decoded["distances"][slots]
        self._bricks = None
        return self._copies


class BrickCache:
    """Hash table of decoded bricks of one revision, by key, empty ones included.

    All are dropped for other objects, and for a frame that does not fit.

    directory (C,) of `BRICK`, at most half full; decoded () of `OCCUPIED` or `MEASURED`; n_kept :
    bricks; most_rows : slots; number : of the filter last given to `choose`.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._objects: Mapping[int, Object] | None = None
        self._reads = False
        self._exclude = NO_KEYS
        self._frames: list[ref[CachedRows]] = []
        self.number = 0
        self._allocate(reads=False)

    def _allocate(self, *, reads: bool) -> None:
        """Allocate slots for rows. The system backs pages with memory at their first write."""
        self._reads = reads
        self.decoded: Records = np.zeros((), MEASURED if reads else OCCUPIED)
        self.most_rows = len(self.decoded["id"])
        self.clear()

    def clear(self) -> None:
        """Drop all bricks; live frames copy their rows first."""
        for entries in self._frames:
            if (frame := entries()) is not None:
                frame.copied()
        self._frames.clear()
        self.directory: Records = np.zeros(LEAST_ENTRIES, BRICK)
        self._used, self.n_kept = 1, 0

    def choose(self, objects: Mapping[int, Object], exclude: Keys, *, reads: bool) -> None:
        """Restrict the memory to bricks of these objects, with distances if read, for a filter.

        objects : of one revision; another mapping for other objects.
        """
        if objects is not self._objects:
            self._objects = objects
            self.clear()
        if reads is not self._reads:
            self.clear()
            self._allocate(reads=reads)
        if exclude is not self._exclude and not np.array_equal(exclude, self._exclude):
            self.number += 1
        self._exclude = exclude

    def absent(self, keys: Keys) -> Keys:
        """Keys without a brick here, of ascending keys (U,)."""
        found = np.empty_like(keys)
        return found[: kernels.absent_bricks(self.directory, keys, found)]

    def enter(self, keys: Keys, rows: Rows) -> bool:
        """Insert absent bricks (U,), ascending, with their rows; returns whether they fit."""
        most = self._used + len(rows) + len(rows) // 2
        n_kept = self.n_kept + len(keys)
        if most > self.most_rows or 2 * n_kept > ENTRIES_A_ROW * self.most_rows:
            return False
        while 2 * n_kept > len(self.directory):
            larger = np.zeros(2 * len(self.directory), BRICK)
            kernels.copy_entries(self.directory, larger)
            self.directory = larger
        band = rows.distances if self._reads else NO_DISTANCES.distances
        assert band is not None  # noqa: S101 - they were asked for
        used = kernels.enter_bricks(
            self.directory, self.decoded, keys, rows.keys, rows.ids, rows.occupancy, *band,
            self._used,
        )  # fmt: skip
        if used < 0:
            self.clear()
            raise damaged(self._url, f"row {-1 - used} of {len(rows)} rows of distances is damaged")
        self._used, self.n_kept = used, n_kept
        return True

    def rows(self, placed: NDArray[np.float64], addresses: NDArray[np.int64]) -> CachedRows:
        """Rows of a frame; placed, addresses : outputs of its kernel."""
        frame = CachedRows((self.directory, self.decoded), placed, addresses)
        if len(self._frames) >= MOST_FRAMES:
            self._frames = [entries for entries in self._frames if entries() is not None]
        self._frames.append(ref(frame))
        return frame
