"""Tables of cells of one environment: one for each set of excluded objects, while it is used."""

import threading
from collections.abc import Sequence
from contextlib import closing

from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.store.connect import open_store
from hapticdb.store.finding import find_objects

Words = Sequence[int | str]


class SharedTables:
    """Tables of one environment, each with its fetching process, made when they are first needed.

    Parameters
    ----------
    url : str
        The environment.
    budget_bytes : int
        Memory of each table.
    """

    def __init__(self, url: str, budget_bytes: int) -> None:
        self.url, self._budget_bytes = url, budget_bytes
        self._tables: dict[tuple[int, ...], ResidentCells] = {}
        self._uses: dict[tuple[int, ...], int] = {}
        self._making = threading.Lock()

    def excluded(self, where: Words, exclude: Words) -> tuple[int, ...]:
        """Ids of the objects that are not felt: chosen by `exclude`, or not chosen by `where`.

        Raises
        ------
        ObjectNotFoundError
            If a word chooses nothing.
        """
        if not where and not exclude:
            return ()
        with closing(open_store(self.url, read_only=True)) as store:
            left_out = {obj.id for obj in find_objects(store, exclude)}
            if where:
                chosen = {obj.id for obj in find_objects(store, where)}
                left_out |= {obj.id for obj in store.objects()} - chosen
        return tuple(sorted(left_out))

    def take(self, excluded: tuple[int, ...]) -> ResidentCells:
        """Table without those objects, for one more session."""
        with self._making:
            if excluded not in self._tables:
                self._tables[excluded] = ResidentCells(
                    self.url, budget_bytes=self._budget_bytes, exclude=excluded
                )
                self._uses[excluded] = 0
            self._uses[excluded] += 1
            return self._tables[excluded]

    def release(self, cells: ResidentCells) -> None:
        """Give a table back; the last session frees it."""
        with self._making:
            excluded = cells.exclude
            self._uses[excluded] -= 1
            if self._uses[excluded]:
                return
            del self._tables[excluded], self._uses[excluded]
        cells.close()

    def all(self) -> list[ResidentCells]:
        """Tables that are in use."""
        with self._making:
            return list(self._tables.values())

    def close(self) -> None:
        """Free all tables."""
        with self._making:
            for cells in self._tables.values():
                cells.close()
            self._tables.clear()
            self._uses.clear()
