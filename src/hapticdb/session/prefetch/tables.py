"""Tables of cells of one environment, one for each filter in use."""

import threading

from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.store.filtering import Filter


class SharedTables:
    """Tables of one environment, each of `budget_bytes`, made when first needed."""

    def __init__(self, url: str, budget_bytes: int) -> None:
        self.url, self._budget_bytes = url, budget_bytes
        self._tables: dict[Filter, ResidentCells] = {}
        self._uses: dict[Filter, int] = {}
        self._making = threading.Lock()

    def take(self, felt: Filter) -> ResidentCells:
        """Table of the filter's objects, for one more session."""
        with self._making:
            if felt not in self._tables:
                self._tables[felt] = ResidentCells(
                    self.url, budget_bytes=self._budget_bytes, where=felt.where,
                    exclude=felt.exclude,
                )  # fmt: skip
                self._uses[felt] = 0
            self._uses[felt] += 1
            return self._tables[felt]

    def release(self, cells: ResidentCells) -> None:
        """Give a table back; the last session frees it."""
        with self._making:
            felt = cells.filter
            self._uses[felt] -= 1
            if self._uses[felt]:
                return
            del self._tables[felt], self._uses[felt]
        cells.close()

    def all(self) -> list[ResidentCells]:
        """Tables in use; does not wait while one is made."""
        return list(self._tables.values())

    def close(self) -> None:
        """Free all tables."""
        with self._making:
            for cells in self._tables.values():
                cells.close()
            self._tables.clear()
            self._uses.clear()
