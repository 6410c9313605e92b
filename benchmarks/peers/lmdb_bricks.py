"""LMDB: a B+-tree in a file mapped into memory, without SQL.

Rows are bricks, as hapticdb keeps them, those of several objects merged: a frame asks for some 30
bricks where it would ask for 300 voxels, in a file of 11 MB where voxels would take 300. Keys are
8 bytes, big endian, so that bytes sort as numbers do; they come in order, which LMDB appends.
"""

from typing import Any

import lmdb
import numpy as np

from hapticdb.store.base import BRICK_BYTES, Keys
from peers import PeerWork
from peers.rows import Found, RowPeer

ORDERED = ">i8"
KEY_BYTES = 8
ROOM = 4096
"""Bytes of the file to allow for a brick: a page each; only what is used is written."""


class LmdbBricks(RowPeer):
    """Bricks in LMDB; one read transaction and one cursor a frame."""

    name = "LMDB"
    layout = "brick"

    def load(self, work: PeerWork) -> None:
        self._file = work.folder / "bricks.mdb"
        keys, occupancy, _ = work.bricks
        size = (1 << 20) + ROOM * len(keys)
        self._env: Any = lmdb.open(str(self._file), subdir=False, map_size=size, lock=False)
        ordered, bits = _split(keys), occupancy.tobytes()
        rows = (
            (key, bits[n * BRICK_BYTES : (n + 1) * BRICK_BYTES]) for n, key in enumerate(ordered)
        )
        with self._env.begin(write=True) as transaction:
            _, added = transaction.cursor().putmulti(rows, append=True)
        assert added == len(keys)

    def look_up(self, keys: Keys) -> Found:
        with self._env.begin(buffers=True) as transaction:
            rows = transaction.cursor().getmulti(_split(keys))
            found = b"".join([key for key, _ in rows])
            bits = b"".join([value for _, value in rows])
        return np.frombuffer(found, ORDERED).astype(np.int64), np.frombuffer(bits, np.uint8)

    def size(self) -> tuple[str, int]:
        return "file", self._file.stat().st_blocks * 512

    def close(self) -> None:
        self._env.close()
        self._file.unlink()


def _split(keys: Keys) -> list[bytes]:
    """Keys as LMDB sorts them."""
    ordered = keys.astype(ORDERED).tobytes()
    return [ordered[at : at + KEY_BYTES] for at in range(0, len(ordered), KEY_BYTES)]


PEERS = (LmdbBricks,)
