"""The user's cache of slow results, keyed by a digest of all their inputs.

It is in the same folder as the machine code of kernels. Entries that are missing, damaged or of
other sources are recomputed.
"""

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path

from hapticdb.kernels._cache import cache_folder, sources_digest

MOST_BYTES = 256 << 20
"""Bytes of all entries of a kind, at most. Larger: more hits."""


def entry_of(kind: str, *shaping: object) -> Path:
    """File of an entry, keyed by these values and the sources of this package."""
    known = repr((sources_digest(Path(__file__).parent), *shaping))
    return cache_folder() / kind / hashlib.sha256(known.encode(errors="replace")).hexdigest()


def content_of(entry: Path) -> bytes | None:
    """Content of an entry; None if it is missing or damaged."""
    try:
        with entry.open("rb") as stream:
            digest, content = stream.read(32), stream.read()  # SHA-256, then the content
    except OSError:
        return None
    if hashlib.sha256(content).digest() != digest:
        return None
    with contextlib.suppress(OSError):  # time of the last use, for eviction
        os.utime(entry)
    return content


def keep(entry: Path, content: bytes) -> None:
    """Write an entry atomically; no error for a folder without write access."""
    if len(content) > MOST_BYTES:
        return
    with contextlib.suppress(OSError):
        entry.parent.mkdir(exist_ok=True)
        number, unfinished = tempfile.mkstemp(dir=entry.parent)
        try:
            with os.fdopen(number, "wb") as stream:
                stream.write(hashlib.sha256(content).digest() + content)
            Path(unfinished).replace(entry)
        finally:
            Path(unfinished).unlink(missing_ok=True)
        _make_room(entry.parent)


def _make_room(folder: Path) -> None:
    """Evict the least recently used entries, down to `MOST_BYTES`."""
    found = sorted((one.stat().st_mtime, one.stat().st_size, one) for one in folder.iterdir())
    left = sum(size for _, size, _ in found)
    for _, size, one in found:
        if left <= MOST_BYTES:
            break
        one.unlink()
        left -= size
