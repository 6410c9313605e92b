"""What a server has pushed: the newest revision, and the writes and cells before it."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.protocol.cells import NewsBody
from hapticdb.store.base import CELL_SHIFT, Change, Keys, Layout, Object, Rows, row_shift
from hapticdb.store.batches import joined
from hapticdb.store.messages import change_of_body, object_of_body, rows_of_body


class RemoteNews:
    """Pushes that have come since the last snapshot, as one.

    Attributes
    ----------
    revision : int
        The newest revision. All that follows holds for it.
    since, has_all, changes
        Whether `changes` has every write after the revision `since`.
    objects : dict of int to Object
        Objects that these writes have written.
    cells : dict of int to Rows
        Rows of the cells that were read before and are touched, by the cells' keys on the curve.
    distances : bool
        Whether these rows have distances.
    """

    def __init__(self, url: str, layout: Layout, revision: int, body: NewsBody) -> None:
        self.revision = revision
        self.since = body.since
        self.has_all = body.has_all
        self.changes: list[Change] = [change_of_body(url, change) for change in body.changes]
        self.objects: dict[int, Object] = {
            obj.object_id: object_of_body(url, obj) for obj in body.objects
        }
        self.distances = body.rows.lengths is not None
        rows = rows_of_body(url, body.rows, layout, distances=self.distances)
        cells = rows.keys >> (CELL_SHIFT - row_shift(layout))
        ends = np.searchsorted(cells, body.cells, side="right").tolist()
        starts = np.searchsorted(cells, body.cells).tolist()
        spans = zip(body.cells.tolist(), starts, ends, strict=True)
        self.cells: dict[int, Rows] = {cell: rows.part(low, high) for cell, low, high in spans}

    def joined_to(self, older: "RemoteNews | None") -> "RemoteNews":
        """These news together with older ones that nobody has used yet; changes these."""
        if older is None or not (self.has_all and older.has_all) or older.revision != self.since:
            return self
        if older.distances == self.distances:
            touched = _cells_of(self.changes)
            kept = [c for c in older.cells if c not in self.cells and not _is_in(c, touched)]
            self.cells |= {cell: older.cells[cell] for cell in kept}
        written = {change.id for change in self.changes}
        self.objects |= {i: obj for i, obj in older.objects.items() if i not in written}
        self.changes = older.changes + self.changes
        self.since = older.since
        return self

    def changes_after(self, revision: int) -> list[Change] | None:
        """Every write after a revision, oldest first; None if that is not known."""
        if not self.has_all or revision < self.since:
            return None
        return [change for change in self.changes if change.revision > revision]

    def rows_of_cells(self, cells: Keys, *, distances: bool) -> Rows | None:
        """Rows of cells (n,), ascending on the curve; None if those of any cell were not pushed."""
        if distances != self.distances:
            return None
        found = [self.cells.get(cell) for cell in cells.tolist()]
        parts = [rows for rows in found if rows is not None]
        if len(parts) < len(found):
            return None
        return joined([rows for rows in parts if len(rows)], distances=distances)


def _cells_of(changes: list[Change]) -> NDArray[np.int64]:
    """Ranges of cells (C, 2) that writes have touched."""
    spans = [change.ranges >> CELL_SHIFT for change in changes]
    return np.concatenate([*spans, np.empty((0, 2), np.int64)])


def _is_in(cell: int, spans: NDArray[np.int64]) -> bool:
    return bool(((spans[:, 0] <= cell) & (cell <= spans[:, 1])).any())
