"""NEWS for one client: what was written since its last, and the rows of cells it has read."""

from contextlib import suppress

import numpy as np

from hapticdb.errors import ObjectNotFoundError
from hapticdb.protocol import cells as bodies
from hapticdb.protocol.cells import NewsBody
from hapticdb.server.cells.limits import MOST_NEWS_BYTES, MOST_NEWS_CELLS, MOST_NEWS_CHANGES
from hapticdb.server.cells.recent import RecentCells
from hapticdb.store.base import (
    BRICK_BYTES,
    CELL_SHIFT,
    NO_KEYS,
    Change,
    Keys,
    Object,
    Rows,
    Store,
    row_shift,
)
from hapticdb.store.batches import no_rows
from hapticdb.store.messages import change_body, object_body, rows_body


def news_since(store: Store, since: int, recent: RecentCells) -> tuple[int, NewsBody]:
    """Newest revision, and the news after the revision `since`, all of one snapshot."""
    with store.snapshot():
        revision = store.revision()
        changes = _changes(store, since, revision)
        if changes is None:
            nothing = rows_body(no_rows(distances=recent.distances), bodies.COMPLETE)
            return revision, NewsBody(since, False, [], [], NO_KEYS, nothing)  # noqa: FBT003 - a record
        objects = _objects_of(store, changes)
        cells, rows = _rows_of_cells(store, changes, recent)
    sent = [object_body(obj) for obj in objects]
    told = [change_body(change) for change in changes]
    body = rows_body(rows, bodies.COMPLETE)
    return revision, NewsBody(since, True, told, sent, cells, body)  # noqa: FBT003 - a record


def _changes(store: Store, since: int, revision: int) -> list[Change] | None:
    """Every write after a revision, or None if there are too many to tell."""
    if not 0 <= revision - since <= MOST_NEWS_CHANGES:
        return None
    changes = list(store.changes(since)) if revision > since else []
    return changes if len(changes) >= revision - since else None


def _objects_of(store: Store, changes: list[Change]) -> list[Object]:
    """Objects that writes have written and that are still there."""
    objects = []
    for object_id in sorted({change.id for change in changes if change.action != "remove"}):
        with suppress(ObjectNotFoundError):  # removed by a later write
            objects.append(store.object(object_id))
    return objects


def _rows_of_cells(store: Store, changes: list[Change], recent: RecentCells) -> tuple[Keys, Rows]:
    """Cells that the client has read and the changes have touched, with their rows."""
    cells = recent.touched(changes, MOST_NEWS_CELLS)
    if not len(cells):
        return cells, no_rows(distances=recent.distances)
    shift = CELL_SHIFT - row_shift(store.layout)
    starts = np.flatnonzero(np.diff(cells, prepend=-2) > 1)
    ends = np.append(starts[1:], len(cells)) - 1
    lows, highs = cells[starts] << shift, ((cells[ends] + 1) << shift) - 1
    rows = store.scan(lows, highs, distances=recent.distances)
    n_bytes = (18 + BRICK_BYTES * bool(shift)) * np.arange(1, len(rows) + 1)
    if rows.distances is not None:
        n_bytes += rows.distances.ends
    fits = int(np.searchsorted(n_bytes, MOST_NEWS_BYTES, side="right"))
    if fits < len(rows):  # whole cells alone
        first_left_out = int(rows.keys[fits]) >> shift
        cells = cells[: int(np.searchsorted(cells, first_left_out))]
        rows = rows.part(0, int(np.searchsorted(rows.keys, first_left_out << shift)))
    return cells, rows
