"""Chunks of a recording: found and checked, their frames left packed."""

import io
import struct
import zlib
from typing import NamedTuple, Self

from hapticdb.recording.frame import FRAME

MOST_FRAMES = 1 << 16
"""Frames that a chunk may have: a reader needs no more memory than for so many."""
MARK = b"HDBC"
HEAD = struct.Struct("<4sIQIII")
SEARCHED = 1 << 20
"""Bytes looked through at once for a further chunk."""


class Chunk(NamedTuple):
    """Head of a chunk: index of its first frame, their number, size and CRC-32 of its payload.

    No frames: the mark that a recorder was closed here.
    """

    first: int
    n_frames: int
    n_bytes: int
    crc: int

    def packed(self) -> bytes:
        """The head's bytes."""
        head = HEAD.pack(MARK, self.n_frames, self.first, self.n_bytes, self.crc, 0)[:-4]
        return head + struct.pack("<I", zlib.crc32(head))

    @classmethod
    def parse(cls, content: bytes) -> Self | None:
        """Head in the first bytes, None where there is none."""
        if len(content) < HEAD.size or not content.startswith(MARK):
            return None
        _, n_frames, first, n_bytes, crc, head_crc = HEAD.unpack(content[: HEAD.size])
        if zlib.crc32(content[: HEAD.size - 4]) != head_crc or n_frames > MOST_FRAMES:
            return None
        # deflating makes nothing 1,033 times shorter, nor longer but by a few bytes
        plain = n_frames * FRAME.itemsize
        if not plain <= 1032 * n_bytes <= 1032 * (1.01 * plain + (4096 if n_frames else 0)):
            return None
        return cls(first, n_frames, n_bytes, crc)


class Scan(NamedTuple):
    """Whole chunks of a file: where each payload begins, frames in all, where the last one ends.

    damaged : index of the first frame that is lost although whole chunks follow, or -1.
    """

    chunks: list[tuple[int, Chunk]]
    n_frames: int
    end: int
    damaged: int


def scan(file: io.RawIOBase, start: int, size: int) -> Scan:
    """Whole chunks from `start` on, up to the first that is not: torn, or damaged."""
    chunks: list[tuple[int, Chunk]] = []
    n_frames, at = 0, start
    is_damaged = False
    while at < size:
        file.seek(at)
        chunk = Chunk.parse(read_bytes(file, HEAD.size))
        is_misplaced = chunk is not None and chunk.first != n_frames
        if chunk is None or is_misplaced or not _is_whole(read_bytes(file, chunk.n_bytes), chunk):
            is_damaged = is_misplaced or _has_chunk_after(file, at, size)
            break
        if chunk.n_frames:
            chunks.append((at + HEAD.size, chunk))
        n_frames += chunk.n_frames
        at += HEAD.size + chunk.n_bytes
    return Scan(chunks, n_frames, at, n_frames if is_damaged else -1)


def _is_whole(payload: bytes, chunk: Chunk) -> bool:
    return len(payload) == chunk.n_bytes and zlib.crc32(payload) == chunk.crc


def _has_chunk_after(file: io.RawIOBase, at: int, size: int) -> bool:
    """Whether a whole chunk begins behind `at`: then what is at `at` is no torn end."""
    while at + 1 < size:
        file.seek(at + 1)
        content = read_bytes(file, SEARCHED)
        found = -1
        while (found := content.find(MARK, found + 1)) >= 0:
            chunk = Chunk.parse(content[found : found + HEAD.size])
            if chunk is not None and at + 1 + found + HEAD.size + chunk.n_bytes <= size:
                return True
        at += max(SEARCHED - HEAD.size, 1)
    return False


def read_bytes(file: io.RawIOBase, n_bytes: int) -> bytes:
    """So many bytes, or fewer at the end of the file."""
    content = b""
    while len(content) < n_bytes and (more := file.read(n_bytes - len(content))):
        content += more
    return content
