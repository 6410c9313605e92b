"""Empties the page caches that a private server uses: its own and the operating system's."""

import os
from pathlib import Path

import psycopg

BLOCKS = 2000
"""Number of 8 KB blocks that are read to evict all others from a cache of 4 MB."""
FILL = f"""
CREATE TABLE IF NOT EXISTS public.filler (n int PRIMARY KEY, pad text);
ALTER TABLE public.filler ALTER COLUMN pad SET STORAGE PLAIN;
INSERT INTO public.filler SELECT n, repeat('x', 7000) FROM generate_series(1, {BLOCKS}) AS s(n)
    ON CONFLICT DO NOTHING;
CHECKPOINT"""
# by the index: a scan of the whole table uses a small ring of buffers and does not fill the cache
PUSH_OUT = f"SELECT sum(length(pad)) FROM public.filler WHERE n BETWEEN 1 AND {BLOCKS}"


class Cold:
    """Empties the caches of a private server, whose own cache must be small."""

    def __init__(self, conninfo: str, data: Path) -> None:
        self._connection = psycopg.connect(conninfo, autocommit=True)
        for statement in FILL.split(";"):
            self._connection.execute(statement)
        self._connection.execute("SET enable_seqscan = off")
        self._connection.execute("SET enable_bitmapscan = off")
        self._files = [path for path in (data / "base").rglob("*") if path.is_file()]

    def __call__(self) -> None:
        """Empty both caches."""
        self._connection.execute(PUSH_OUT)
        for path in self._files:
            try:
                descriptor = os.open(path, os.O_RDONLY)
            except FileNotFoundError:
                continue
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            os.close(descriptor)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()
