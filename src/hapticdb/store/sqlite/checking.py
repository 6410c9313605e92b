"""What `hapticdb check` asks of an SQLite file: pages, log, indexes, statistics."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import apsw
import numpy as np

from hapticdb.store import believed
from hapticdb.store.base import Layout, Rows, Table
from hapticdb.store.batches import NO_DISTANCES
from hapticdb.store.sqlite import pages as sqlite_pages
from hapticdb.store.sqlite import raw as sqlite_bytes
from hapticdb.store.sqlite.pages import (
    FRAME_BYTES,
    LOG_HEADER,
    PAGE_BYTES,
    PENDING_PAGE,
    is_whole,
    log_checksum,
    nonce_of,
    words_checksum,
)
from hapticdb.store.sqlite.raw import read_from
from hapticdb.store.sqlite.tables.ranges import BAND_COLUMNS
from hapticdb.store.sqlite.tables.reading import SQLiteReader

Fetch = Callable[[str, Sequence[Any]], list[Any]]
PAGES_AT_ONCE = 512
MOST = 100
"""Findings of one kind that are listed. A larger value makes the report of a ruined file longer."""
LOOKS = 5
"""Times that a page with a wrong checksum is read again: another process may be writing it."""
AFTER: dict[Table, str] = {
    "voxel": """
SELECT z_val, id FROM voxel
 WHERE (z_val, id) > (?1, ?2) ORDER BY z_val, id LIMIT ?3""",
    "brick": """
SELECT z_val, id, occupancy FROM brick
 WHERE (z_val, id) > (?1, ?2) ORDER BY z_val, id LIMIT ?3""",
    "band": f"""
SELECT {BAND_COLUMNS} FROM band
 WHERE (z_val, id) > (?1, ?2) ORDER BY z_val, id LIMIT ?3""",
}


class SQLiteChecker:
    """What `hapticdb check` asks a file: SQLite's own check, statistics, all rows in order."""

    def __init__(self, path: Path, layout: Layout, fetch: Fetch, reader: SQLiteReader) -> None:
        self._path = path
        self._layout = layout
        self._fetch = fetch
        self._reader = reader

    def has_page_checksums(self) -> bool:
        """Whether the file's pages carry checksums."""
        return sqlite_pages.is_checked(sqlite_bytes.read_bytes(self._path, PAGE_BYTES))

    def findings(self) -> Iterator[str]:
        """What is wrong with indexes and kept statistics, a line each."""
        for (line,) in self._fetch(f"PRAGMA integrity_check({MOST})", ()):
            if line != "ok":
                yield " ".join(str(line).split())
        kept = self._fetch("SELECT bounds, n_rows FROM quantile", ())
        costs = self._fetch("SELECT figures FROM cost", ())
        yield from believed.findings_of_kept(str(self._path), kept, costs)

    def rows_after(self, key: int, object_id: int, limit: int, *, distances: bool = False) -> Rows:
        """At most that many rows after (key, id), ascending by both."""
        if distances and not self._reader.has_band():
            return NO_DISTANCES
        table: Table = "band" if distances else self._layout
        found = self._fetch(AFTER[table], (key, object_id, limit))
        return self._reader.unpacked(found, distances=distances)


def page_findings(path: Path) -> Iterator[str]:
    """Check the checksum of every page of a file, also of pages that no query reads."""
    with sqlite_bytes.opened_bytes(path) as file:
        first = read_from(file, PAGE_BYTES)
        if not sqlite_pages.is_checked(first):
            return
        nonce, number, n_broken = nonce_of(first), 1, 0
        while chunk := read_from(file, PAGE_BYTES * PAGES_AT_ONCE, (number - 1) * PAGE_BYTES):
            for start in range(0, len(chunk), PAGE_BYTES):
                page = chunk[start : start + PAGE_BYTES]
                if (
                    number != PENDING_PAGE
                    and not is_whole(page, number, nonce)
                    and not _is_whole_later(file, number, nonce)
                ):
                    n_broken += 1
                    if n_broken <= MOST:
                        yield f"page {number} is not what was written"
                number += 1
    if n_broken > MOST:
        yield f"{n_broken:,} pages in all are not what was written"


def _is_whole_later(file: apsw.VFSFile, number: int, nonce: bytes) -> bool:
    for _ in range(LOOKS):
        time.sleep(0.01)
        if is_whole(read_from(file, PAGE_BYTES, (number - 1) * PAGE_BYTES), number, nonce):
            return True
    return False


def log_findings(path: Path) -> Iterator[str]:
    """Commits in the log after a broken frame, which SQLite ignores without an error.

    Call it before the file is opened: closing the file may remove the log.
    """
    log = Path(f"{path}-wal")
    if not log.exists():
        return
    with log.open("rb") as file:
        header = file.read(LOG_HEADER)
        if len(header) < LOG_HEADER:
            return
        order = ">" if header[3] & 1 else "<"
        sums = int.from_bytes(header[24:28], "big"), int.from_bytes(header[28:32], "big")
        if sums != words_checksum(np.frombuffer(header[:24], f"{order}u4").tolist()):
            yield "the header of its -wal is not as written: what was committed in it is left out"
            return
        number, broken = 0, 0
        while len(frame := file.read(FRAME_BYTES)) == FRAME_BYTES:
            number += 1
            is_of_this_round = frame[8:16] == header[16:24]  # others are from an earlier log
            if not broken:
                sums = log_checksum(np.frombuffer(frame, f"{order}u4"), *sums)
                told = sums[0].to_bytes(4, "big") + sums[1].to_bytes(4, "big")
                broken = 0 if is_of_this_round and told == frame[16:24] else number
            elif is_of_this_round and any(frame[4:8]) and any(frame[16:24]):
                yield (
                    f"frame {broken} of its -wal is not as written: what was committed after it "
                    "is left out"
                )
                return


def first_findings(path: Path) -> list[str]:
    """Damage that is found without opening the file; a line each."""
    try:
        return [*log_findings(path), *page_findings(path)]
    except OSError:
        return []
