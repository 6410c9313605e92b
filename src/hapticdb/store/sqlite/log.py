"""Whether a write-ahead log belongs to the file beside it.

A log of SQLite does not name its file. SQLite applies whatever ``-wal`` lies beside a file, even to
an old copy that was put in the file's place. So the row of the table `environment` has a lineage: a
random mark, new with each commit of hapticdb, and the mark of the commit before. The row is on
page 2, so each of these commits has page 2 in the log.

A log begins where the last complete checkpoint left the file, and a checkpoint copies pages of
committed frames only. So the mark in the file is the mark before the log's first one, or one of the
log's marks, whenever a process or the machine died. The mark of any other file is neither.

Layouts: https://sqlite.org/fileformat2.html, sections 1.5, 1.6, 2.1 and 4.
"""

import contextlib
import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import DamagedError
from hapticdb.store.sqlite import raw as sqlite_bytes
from hapticdb.store.sqlite.raw import PAGE_BYTES

MARK_BYTES = 16
NO_MARK = bytes(MARK_BYTES)
"""Mark of a file older than format 2, and the previous mark of a file without earlier commits."""
LINEAGE_COLUMN = 8
"""Index of the column `lineage` in the table `environment`."""
LINEAGE_PAGE = 2
"""Number of the only page of the table `environment`, which is made first."""
LINEAGE_AT = (LINEAGE_PAGE - 1) * PAGE_BYTES
RENEW_LINEAGE = """
UPDATE environment SET lineage = CAST(randomblob(16) || substr(lineage, 1, 16) AS BLOB)"""
"""Statement that every writing transaction runs: draws a new mark, and keeps the former one."""

LEAF_OF_TABLE = 13
BLOB_TYPE = 12
"""SQLite's serial type of an empty blob. Each byte of a blob adds 2."""
NUMBER_BYTES = (0, 1, 2, 3, 4, 6, 8, 8, 0, 0)
"""Bytes of a value of each serial type below 10."""

LOG_HEADER = 32
FRAME_HEADER = 24
FRAME_BYTES = FRAME_HEADER + PAGE_BYTES
LOG_MAGIC = 0x377F0682
"""First word of a log. It is 1 more if checksums are computed from big-endian words."""
SUMS = struct.Struct(">2I")
ATTEMPTS = 10
"""Times that file and log are read before the log is refused. A larger value waits longer for a
writer."""
PAUSE_SECONDS = 0.02
"""Pause between attempts. A writer may change the log between the reads of file and log."""


class _Lineage(NamedTuple):
    """Mark of the last commit that a page has seen, and of the one before it."""

    mark: bytes
    previous: bytes


def first_lineage() -> bytes:
    """Lineage of a new file: a mark that is in no log, and no previous mark."""
    return os.urandom(MARK_BYTES) + NO_MARK


def check_log(path: Path, log_path: Path | None = None) -> bytes | None:
    """Refuse a log beside a database that was written for another file; returns the file's mark.

    Returns None if no mark can be read. After a power loss page 2 may be half written; the log then
    holds the whole page. `log_path` is another path of the log, for a log whose name is gone.

    Raises `DamagedError` when the log has commits that cannot be applied to this file.
    """
    for attempt in range(ATTEMPTS):
        if attempt:
            time.sleep(PAUSE_SECONDS)
        try:
            with contextlib.closing(_Log.at(log_path or Path(f"{path}-wal"))) as log:
                mark = file_mark(path)  # before the log's frames: may be their newest
                if mark is None or log.follows(mark):
                    return mark
        except OSError:
            return None  # SQLite's own error for an unreadable file is clearer
    raise not_its_log(path)


def not_its_log(path: Path) -> DamagedError:
    """Build the error for a log that was written for another file."""
    name = path.name
    return DamagedError(
        f"{path} is not the file that {name}-wal and {name}-shm were written for (was a copy put "
        f"in its place?): put that file back, or run 'hapticdb restore COPY {path}'; to open this "
        "one as it is, remove both"
    )


def file_mark(path: Path) -> bytes | None:
    """Mark in the database file itself, without its log; None if it cannot be read."""
    return mark_in(sqlite_bytes.read_bytes(path, PAGE_BYTES, LINEAGE_AT))


def mark_in(page: bytes) -> bytes | None:
    """Mark on page 2 of a database."""
    found = _lineage_in(page)
    return found.mark if found else None


def _lineage_in(page: bytes) -> _Lineage | None:
    """Lineage on the page of the table `environment`; None if the page is another one or broken."""
    try:
        if page[0] != LEAF_OF_TABLE or int.from_bytes(page[3:5], "big") != 1:
            return None
        length, at = _varint(page, int.from_bytes(page[8:10], "big"))
        _, at = _varint(page, at)
        record = page[at : at + length]
        head, at = _varint(record, 0)
        kinds = []
        while at < head:
            kind, at = _varint(record, at)
            kinds.append(kind)
        if len(kinds) < LINEAGE_COLUMN:
            return None
        if len(kinds) == LINEAGE_COLUMN or kinds[LINEAGE_COLUMN] == 0:
            return _Lineage(NO_MARK, NO_MARK)  # the file has no such column yet
        if kinds[LINEAGE_COLUMN] != BLOB_TYPE + 2 * 2 * MARK_BYTES:
            return None
        at = head + sum(_bytes_of(kind) for kind in kinds[:LINEAGE_COLUMN])
        lineage = record[at : at + 2 * MARK_BYTES]
    except IndexError:
        return None
    if len(lineage) < 2 * MARK_BYTES:
        return None
    return _Lineage(lineage[:MARK_BYTES], lineage[MARK_BYTES:])


def _varint(page: bytes, at: int) -> tuple[int, int]:
    """Integer of variable length, and the offset after it."""
    value = 0
    for n in range(9):
        byte = page[at + n]
        if n == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 127
        if byte < 128:
            return value, at + n + 1
    raise IndexError


def _bytes_of(kind: int) -> int:
    """Bytes of a value of that serial type."""
    return NUMBER_BYTES[kind] if kind < BLOB_TYPE else (kind - BLOB_TYPE) // 2


class _Log:
    """A log, read as far as its frames carry the salts of its header."""

    def __init__(self, descriptor: int | None) -> None:
        self._descriptor = descriptor
        header = self._read(LOG_HEADER, 0)
        if len(header) < LOG_HEADER:
            header = bytes(LOG_HEADER)
        magic, _, self._page = struct.unpack_from(">3I", header)
        self._order = ">u4" if magic & 1 else "<u4"
        self._salts = header[16:24]
        self._sums = SUMS.unpack_from(header, 24)
        self._is_void = magic & ~1 != LOG_MAGIC or self._sums != _header_sums(header, self._order)

    @classmethod
    def at(cls, path: Path) -> "_Log":
        """The log at a path; an empty log if there is none."""
        try:
            return cls(os.open(path, os.O_RDONLY | os.O_CLOEXEC))
        except FileNotFoundError:
            return cls(None)

    def close(self) -> None:
        """Close the descriptor. No lock is lost by this: SQLite takes no locks on a log."""
        if self._descriptor is not None:
            os.close(self._descriptor)

    def _read(self, amount: int, at: int) -> bytes:
        return b"" if self._descriptor is None else os.pread(self._descriptor, amount, at)

    def follows(self, mark: bytes) -> bool:
        """Whether this log can be applied to a file with that mark; true if it has no commits."""
        if self._is_void:
            return True
        if self._page != PAGE_BYTES:  # no hapticdb file has such pages
            return False
        is_marked = False
        for number, _, at in self._frames():
            # the mark of an uncommitted frame is in no file, so its checksum need not be checked
            if number == LINEAGE_PAGE and (lineage := self._lineage(at)):
                if mark in lineage:
                    return True
                is_marked = True
        return not (is_marked and self._has_commit_of_ours())

    def _frames(self) -> Iterator[tuple[int, int, int]]:
        """For each frame: page number, pages after its commit or 0 without one, and offset."""
        at = LOG_HEADER
        while True:
            head = self._read(FRAME_HEADER, at)
            if len(head) < FRAME_HEADER or head[8:16] != self._salts:
                return
            yield *SUMS.unpack_from(head), at
            at += FRAME_BYTES

    def _lineage(self, at: int) -> _Lineage | None:
        return _lineage_in(self._read(PAGE_BYTES, at + FRAME_HEADER))

    def _has_commit_of_ours(self) -> bool:
        """Whether SQLite would apply a page 2 of this log, judged by the checksums."""
        sums, is_ours = self._sums, False
        for number, pages, at in self._frames():
            frame = self._read(FRAME_BYTES, at)
            if len(frame) < FRAME_BYTES:
                return False
            sums = _log_checksum(np.frombuffer(frame, self._order), *sums)
            if sums != SUMS.unpack_from(frame, 16):
                return False
            is_ours = is_ours or (number == LINEAGE_PAGE and self._lineage(at) is not None)
            if is_ours and pages:
                return True
        return False


def _header_sums(header: bytes, order: str) -> tuple[int, int]:
    """Checksum of a log's header."""
    return _words_checksum(np.frombuffer(header[:24], order).tolist(), 0, 0)


def _log_checksum(frame: NDArray[Any], s1: int, s2: int) -> tuple[int, int]:
    """Both sums after a frame's words (2054,), from the sums before the frame, modulo 2^32.

    SQLite adds the page's number and size and then its content, word after word: s1 += word + s2,
    s2 += the next + s1. Both are linear in the words, with Fibonacci's numbers for weights.
    """
    s1, s2 = _words_checksum(frame[:2].tolist(), s1, s2)
    page = frame[6:].astype(np.uint32, copy=False)
    return (
        (int(_WEIGHTS[0].dot(page)) + _PAST[0] * s1 + _PAST[1] * s2) & 0xFFFFFFFF,
        (int(_WEIGHTS[1].dot(page)) + _PAST[1] * s1 + _PAST[2] * s2) & 0xFFFFFFFF,
    )


def _words_checksum(words: list[int], s1: int, s2: int) -> tuple[int, int]:
    """Both sums after an even number of words, one by one."""
    for even, odd in zip(words[::2], words[1::2], strict=True):
        s1 = (s1 + even + s2) & 0xFFFFFFFF
        s2 = (s2 + odd + s1) & 0xFFFFFFFF
    return s1, s2


def _weights() -> tuple[tuple[NDArray[np.uint32], NDArray[np.uint32]], list[int]]:
    """Weights of a page's words in both sums, and of the sums before the page."""
    n_words = PAGE_BYTES // 4
    numbers = [0, 1]
    while len(numbers) < n_words + 2:
        numbers.append((numbers[-1] + numbers[-2]) & 0xFFFFFFFF)
    fibonacci = np.array(numbers, np.uint32)
    of_words = fibonacci[n_words - 1 :: -1].copy(), fibonacci[n_words:0:-1].copy()
    return of_words, numbers[n_words - 1 :]


_WEIGHTS, _PAST = _weights()
