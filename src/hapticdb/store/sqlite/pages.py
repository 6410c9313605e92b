"""Checksums of pages: a file system layer below SQLite that checks every page it reads.

Each page of a checked file ends with `TAIL_BYTES` that SQLite does not use: a mark, a random number
of the file (its nonce), and a CRC-32 over the page's number, its content, the mark and the nonce.
The tail is written with the page and compared when the page is read. So a page that was altered,
zeroed, moved to another place or taken from another file is found. For pages in the write-ahead log
the layer compares SQLite's own checksum of each frame, which SQLite looks at only after a crash.
See docs/decisions/0011.
"""

import os
import struct
import zlib
from typing import Any

import apsw
import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import DamagedError
from hapticdb.store.sqlite.migrations import CHECKED_VERSION

LAYER = "hapticdb"
"""Name under which SQLite knows the layer."""
PAGE_BYTES = 8192
"""Bytes of a page: the block size of the paper."""
MARK = b"HapC"
"""First bytes of the tail of a page that carries a checksum."""
NONCE_BYTES = 8
"""Bytes of the random number of a file, after the mark."""
TAIL_BYTES = 16
"""Bytes at the end of each page that SQLite leaves to us: mark, nonce, CRC-32."""
CONTENT_BYTES = PAGE_BYTES - TAIL_BYTES
"""Bytes of a page that SQLite uses."""
CRC_AT = PAGE_BYTES - 4
"""Offset of the CRC-32 in a page."""
PENDING_PAGE = (1 << 30) // PAGE_BYTES + 1
"""Number of the page that SQLite uses for locks and never writes."""
# https://sqlite.org/fileformat2.html, section 4: the write-ahead log
LOG_HEADER = 32
FRAME_HEADER = 24
FRAME_BYTES = FRAME_HEADER + PAGE_BYTES
_SUMS = struct.Struct(">2I")
NEVER = 1 << 62
"""Offset beyond the end of every log."""


def tail_of(content: bytes | memoryview, number: int, nonce: bytes) -> bytes:
    """Last 16 bytes of a page, from its other bytes, its number (from 1) and its file's nonce."""
    start = MARK + nonce
    crc = zlib.crc32(content, zlib.crc32(start + number.to_bytes(4, "big")))
    return start + crc.to_bytes(4, "big")


def is_whole(page: bytes, number: int, nonce: bytes) -> bool:
    """Whether a page is as it was written: the page of that number in the file with that nonce."""
    return page[CONTENT_BYTES:] == tail_of(memoryview(page)[:CONTENT_BYTES], number, nonce)


def is_checked(first: bytes) -> bool:
    """Whether the pages of a file carry checksums, judged by its first page.

    Each of three marks in the page is enough alone, so damage to one does not switch checking off.
    """
    version = int.from_bytes(first[60:64], "big")
    return is_marked(first) or first[20:21] == bytes([TAIL_BYTES]) or version >= CHECKED_VERSION


def is_marked(first: bytes) -> bool:
    """Whether a page has the mark of a page with a checksum."""
    return first[CONTENT_BYTES : CONTENT_BYTES + len(MARK)] == MARK


def nonce_of(first: bytes) -> bytes:
    """Nonce of a file, from its first page."""
    return first[CONTENT_BYTES + len(MARK) : CRC_AT]


class _PageFile(apsw.VFSFile):
    """The database itself: tails are written with its pages and compared when they are read."""

    def __init__(self, name: Any, flags: list[int]) -> None:  # noqa: ANN401 - apsw's own kinds of names
        super().__init__("", name, flags)
        self._path = name.filename() if isinstance(name, apsw.URIFilename) else name
        self._nonce = b""
        self._is_read_only = bool(flags[1] & apsw.SQLITE_OPEN_READONLY)

    def _nonce_known(self) -> bytes:
        """Nonce of the file; a new file draws one."""
        if not self._nonce:
            self._nonce = (
                super().xRead(NONCE_BYTES, CONTENT_BYTES + len(MARK))
                if super().xFileSize() >= PAGE_BYTES
                else os.urandom(NONCE_BYTES)
            )
        return self._nonce

    def xRead(self, amount: int, offset: int) -> bytes:  # noqa: N802 - SQLite's name
        page: bytes = super().xRead(amount, offset)
        if amount != PAGE_BYTES:
            return page  # SQLite reads the header alone before it reads the whole first page
        number = offset // PAGE_BYTES + 1
        if len(page) < PAGE_BYTES:
            if super().xFileSize() == 0:
                return page
            raise damaged_page(self._path, f"page {number} is cut off")
        if not is_whole(page, number, self._nonce or self._nonce_known()):
            raise damaged_page(self._path, f"page {number} is not what was written")
        return page

    def xWrite(self, data: Any, offset: int) -> None:  # noqa: ANN401, N802 - a buffer; SQLite's name
        if len(data) != PAGE_BYTES:
            raise apsw.IOError("a write of less than a page")
        content = bytes(memoryview(data)[:CONTENT_BYTES])
        tail = tail_of(content, offset // PAGE_BYTES + 1, self._nonce or self._nonce_known())
        super().xWrite(content + tail, offset)

    def xLock(self, level: int) -> None:  # noqa: N802 - SQLite's name
        """Refuse a reader exclusive locks: the last one to close asks for one, but needs none."""
        if self._is_read_only and level > apsw.SQLITE_LOCK_SHARED:
            raise apsw.BusyError("opened to read")
        super().xLock(level)

    def xDeviceCharacteristics(self) -> int:  # noqa: N802 - SQLite's name
        """Forbid reads of parts of pages: their checksums could not be compared."""
        return super().xDeviceCharacteristics() & ~apsw.SQLITE_IOCAP_SUBPAGE_READ


class _LogFile(apsw.VFSFile):
    """The write-ahead log: a page read from it is compared with its frame's checksum."""

    def __init__(self, name: Any, flags: list[int]) -> None:  # noqa: ANN401 - apsw's own kinds of names
        super().__init__("", name, flags)
        self._path = name.filename() if isinstance(name, apsw.URIFilename) else name
        self._order = ""
        self._header_end = 0
        self._unsettled = NEVER

    def xRead(self, amount: int, offset: int) -> bytes:  # noqa: N802 - SQLite's name
        start = offset - FRAME_HEADER
        if amount != PAGE_BYTES or start >= self._unsettled:
            return bytes(super().xRead(amount, offset))
        frame: bytes = super().xRead(FRAME_BYTES, start)
        if not self._is_whole(frame, start):
            number = (start - LOG_HEADER) // FRAME_BYTES + 1
            raise damaged_page(
                self._path.removesuffix("-wal"), f"frame {number} of its -wal is not as written"
            )
        return frame[FRAME_HEADER:]

    def _is_whole(self, frame: bytes, start: int) -> bool:
        """Whether a frame has the checksum that follows from the one before it."""
        at = start - FRAME_BYTES + 16 if start > LOG_HEADER else LOG_HEADER - 8
        before = super().xRead(8, at)
        if len(frame) < FRAME_BYTES or len(before) < 8:
            return False
        self._order = self._order or (">" if super().xRead(4, 0)[3] & 1 else "<")
        words = np.frombuffer(frame, f"{self._order}u4")
        sums = log_checksum(words, *_SUMS.unpack(before))
        return sums == _SUMS.unpack_from(frame, 16)

    def xWrite(self, data: Any, offset: int) -> None:  # noqa: ANN401, N802 - a buffer; SQLite's name
        """Note a page written again in a transaction: its checksum follows at the commit."""
        super().xWrite(data, offset)
        if len(data) == FRAME_HEADER:
            self._header_end = offset + FRAME_HEADER
            if any(memoryview(data)[4:8]):  # the frame commits
                self._unsettled = NEVER
        elif len(data) == PAGE_BYTES and offset != self._header_end:
            self._unsettled = min(self._unsettled, offset - FRAME_HEADER)


class _Layer(apsw.VFS):
    """The layer itself, above the engine's own file system."""

    def __init__(self) -> None:
        super().__init__(LAYER, "")

    def xFullPathname(self, name: str) -> str:  # noqa: N802 - SQLite's name
        """Path with links resolved. SQLite's own method does so, but apsw misreads its result."""
        return os.path.realpath(name)

    def xOpen(self, name: Any, flags: list[int]) -> apsw.VFSFile:  # noqa: ANN401, N802 - apsw's own kinds of names; SQLite's name
        if flags[0] & apsw.SQLITE_OPEN_MAIN_DB:
            return _PageFile(name, flags)
        if flags[0] & apsw.SQLITE_OPEN_WAL:
            return _LogFile(name, flags)
        return apsw.VFSFile("", name, flags)


def damaged_page(path: str, cause: str) -> DamagedError:
    """Build the error for a page that is not as it was written."""
    return DamagedError(
        f"{path} is damaged ({cause}): restore a copy with 'hapticdb restore COPY {path}', or "
        "import the files again"
    )


def log_checksum(frame: NDArray[Any], s1: int, s2: int) -> tuple[int, int]:
    """Both sums after a frame's words (2054,), from the sums before the frame, modulo 2^32.

    SQLite adds the page's number and size and then its content, word after word: s1 += word + s2,
    s2 += the next + s1. Both are linear in the words, with Fibonacci's numbers for weights.
    """
    s1, s2 = words_checksum(frame[:2].tolist(), s1, s2)
    page = frame[6:].astype(np.uint32, copy=False)
    return (
        (int(_WEIGHTS[0].dot(page)) + _PAST[0] * s1 + _PAST[1] * s2) & 0xFFFFFFFF,
        (int(_WEIGHTS[1].dot(page)) + _PAST[1] * s1 + _PAST[2] * s2) & 0xFFFFFFFF,
    )


def words_checksum(words: list[int], s1: int = 0, s2: int = 0) -> tuple[int, int]:
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


_LAYER = _Layer()
