"""What `hapticdb check` asks of an SQLite file: its structure, statistics, all rows in order."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hapticdb.store import believed
from hapticdb.store.base import Layout, Rows, Table
from hapticdb.store.batches import NO_DISTANCES
from hapticdb.store.sqlite.tables.ranges import BAND_COLUMNS
from hapticdb.store.sqlite.tables.reading import SQLiteReader

Fetch = Callable[[str, Sequence[Any]], list[Any]]
MOST = 100
"""Findings of one kind that are listed. A larger value makes the report of a ruined file longer."""
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
