"""Chunks of a recording: finds and checks them; does not unpack their frames."""

import io
import struct
import zlib
from typing import NamedTuple, Self

from hapticdb.recording.frame import FRAME

MOST_FRAMES = 1 << 16
"""Greatest number of frames in a chunk. Larger: a reader may need more memory."""
MARK = b"HDBC"
"""First bytes of each chunk."""
HEAD = struct.Struct("<4sIQIII")
"""Head of a chunk: mark, frames, first frame, payload's bytes and CRC-32, CRC-32 of the head."""
SEARCHED = 1 << 20
"""Bytes read at once in the search for a chunk behind a damaged one. Larger: more memory."""


class Chunk(NamedTuple):
    """Head of a chunk.

    first : index of its first frame; n_frames : number of its frames, 0 for the end mark that a
    recorder writes when it closes; n_bytes, crc : size and CRC-32 of its payload.
    """

    first: int
    n_frames: int
    n_bytes: int
    crc: int

    def packed(self) -> bytes:
        """Return the head's bytes."""
        head = HEAD.pack(MARK, self.n_frames, self.first, self.n_bytes, self.crc, 0)[:-4]
        return head + struct.pack("<I", zlib.crc32(head))

    @classmethod
    def parse(cls, content: bytes) -> Self | None:
        """Return the head at the start of `content`, or None if there is no valid one."""
        if len(content) < HEAD.size or not content.startswith(MARK):
            return None
        _, n_frames, first, n_bytes, crc, head_crc = HEAD.unpack(content[: HEAD.size])
        if zlib.crc32(content[: HEAD.size - 4]) != head_crc or n_frames > MOST_FRAMES:
            return None
        # deflate shrinks data less than 1,033 times and lengthens it by a few bytes at most
        plain = n_frames * FRAME.itemsize
        if not plain <= 1032 * n_bytes <= 1032 * (1.01 * plain + (4096 if n_frames else 0)):
            return None
        return cls(first, n_frames, n_bytes, crc)


class Scan(NamedTuple):
    """Whole chunks of a file."""

    chunks: list[tuple[int, Chunk]]  # start of each payload in the file (bytes), and its head
    n_frames: int  # in all chunks
    end: int  # of the last chunk, bytes
    damaged: int  # first frame that is lost although whole chunks follow, or -1


def scan(file: io.RawIOBase, start: int, size: int) -> Scan:
    """Find the whole chunks from `start` (bytes) up to the first that is cut off or damaged."""
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
    """Whether a whole chunk begins behind `at`; if so, the file is damaged there, not cut off."""
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
    """Read `n_bytes` bytes, or fewer at the end of the file."""
    content = b""
    while len(content) < n_bytes and (more := file.read(n_bytes - len(content))):
        content += more
    return content
