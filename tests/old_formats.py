"""Environments in earlier versions of the format."""

import zlib
from contextlib import closing
from pathlib import Path

import apsw

from hapticdb.store.schema import FORMAT_VERSION
from hapticdb.store.sqlite.migrations import APPLICATION_ID, MIGRATIONS
from hapticdb.store.sqlite.raw import PAGE_BYTES
from hapticdb.store.sqlite.store import SQLiteStore


def make_old(path: Path) -> None:
    """Turn a file into one of format 1: no marks of commits."""
    with closing(SQLiteStore.open(path, read_only=True)) as new:
        tables = {
            name: new._connection.fetch(f"SELECT * FROM {name}")
            for name in ("environment", "object", "voxel", "brick", "change")
        }
    path.unlink()
    with closing(apsw.Connection(str(path))) as old:
        old.execute("PRAGMA page_size = 8192")
        for statement in MIGRATIONS["tables"]:
            old.execute(statement)
        tables["environment"] = [row[:8] for row in tables["environment"]]
        for name, rows in tables.items():
            for row in rows:
                old.execute(f"INSERT INTO {name} VALUES ({', '.join('?' * len(row))})", row)
        old.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        old.execute("PRAGMA user_version = 1")
        old.execute("PRAGMA journal_mode = WAL").fetchall()


def give_checksums(path: Path) -> None:
    """Turn a file into one whose pages have checksums in 16 reserved bytes, as they once had."""
    with closing(apsw.Connection(str(path))) as made:
        made.execute("PRAGMA journal_mode = DELETE").fetchall()
        made.reserve_bytes(reserve=16)
        made.execute("VACUUM")
        made.execute(f"PRAGMA user_version = {1000 + FORMAT_VERSION}")
        made.execute("PRAGMA journal_mode = WAL").fetchall()
    content = path.read_bytes()
    with path.open("wb") as file:
        for n in range(len(content) // PAGE_BYTES):
            page, start = content[n * PAGE_BYTES : (n + 1) * PAGE_BYTES - 16], b"HapC" + bytes(8)
            crc = zlib.crc32(page, zlib.crc32(start + (n + 1).to_bytes(4, "big")))
            file.write(page + start + crc.to_bytes(4, "big"))
