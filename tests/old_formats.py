"""Environments in earlier versions of the format."""

from contextlib import closing
from pathlib import Path

import apsw

from hapticdb.store.sqlite.migrations import APPLICATION_ID, MIGRATIONS
from hapticdb.store.sqlite.store import SQLiteStore


def make_old(path: Path) -> None:
    """Turn a file into one of format 1: no marks of commits, no checksums of pages."""
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
