"""Effects of other writers: changed cells, and the excluded objects."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.kernels.resident import cell_table as kernels
from hapticdb.kernels.resident.cells import UNKNOWN
from hapticdb.store.base import CELL_SHIFT, NO_KEYS, Change, Keys, Object, Store
from hapticdb.store.filtering import Filter

MOST_CHANGES = 4096
"""Most writes followed one by one; after more, every cell counts as changed. Larger: cells survive
long absences, and catching up takes longer."""
FEW_CELLS = 1 << 14
"""Most cells in the ranges of writes for a search of each of them. For more, the ranges are
searched for each resident cell. The result is the same; the value decides on speed alone."""


def writes_since(store: Store, known_revision: int, revision: int) -> list[Change] | None:
    """Writes after a revision up to the present one, or None if they cannot be listed.

    They cannot be listed without a revision (below 0), if a server came back without its last
    commits (the revision is ahead), if there are more than `MOST_CHANGES`, or if the store
    has lost some of them.
    """
    # every write adds one revision, so the difference is their number
    n_missed = revision - known_revision
    if known_revision < 0 or not 0 <= n_missed <= MOST_CHANGES:
        return None
    changes = list(store.changes(known_revision)) if n_missed else []
    # a gap in the log: an unseen write may have touched any cell
    return changes if len(changes) >= n_missed else None


def known_cells_touched(
    changes: list[Change],
    grid: Grid,
    slots_of: Callable[[Keys], Keys],
    known: Callable[[], Keys],
) -> Keys:
    """Cells (n,), resident or empty, changed by writes.

    slots_of : slots of cells, UNKNOWN for the unknown ones; known : all resident and empty cells.
    """
    if not changes:
        return NO_KEYS
    spans: NDArray[np.int64] = np.concatenate([change.ranges for change in changes])
    if not len(spans):
        return NO_KEYS
    bits, curve = grid.bits, grid.curve_code
    first, last = spans[:, 0] >> CELL_SHIFT, spans[:, 1] >> CELL_SHIFT
    if (last - first + 1).sum() <= FEW_CELLS:
        changed = np.concatenate([np.arange(a, b + 1) for a, b in zip(first, last, strict=True)])
        cells = kernels.cells_of_curve_keys(np.unique(changed), bits, curve)
        return np.compress(slots_of(cells) != UNKNOWN, cells)
    cells = known()
    on_curve = kernels.curve_keys_of_cells(cells, bits, curve)
    order = np.argsort(on_curve)
    on_curve = on_curve[order]
    # number of spans that hold each cell: +1 at the begin of a span, -1 at its end
    n_holding = np.zeros(len(cells) + 1, dtype=np.int64)
    np.add.at(n_holding, np.searchsorted(on_curve, first), 1)
    np.add.at(n_holding, np.searchsorted(on_curve, last, side="right"), -1)
    return np.compress(np.cumsum(n_holding[:-1]) > 0, cells[order])


class FollowedExclusions:
    """Ids of the objects outside of a filter, at the last followed revision.

    selection : its words are read again when an object is added or removed, or has another name or
    other attributes; a word that chooses nothing any more chooses nothing. ids (E,) : ascending and
    distinct.
    """

    def __init__(self, selection: Filter) -> None:
        self.selection = selection
        self.ids: Keys = selection.fixed_ids if selection.is_fixed else NO_KEYS
        self._objects: dict[int, Object] = {}

    def follow(self, store: Store, changes: Sequence[Change] | None) -> bool:
        """Follow writes in a snapshot of the store; None if they cannot be listed.

        Returns whether only written objects are felt now and were not before, or the reverse.
        """
        if self.selection.is_fixed:
            return True
        if changes is None:
            self._objects = {obj.id: obj for obj in store.objects()}
        elif not self._read_again(store, {change.id for change in changes}):
            return True
        objects = [self._objects[i] for i in sorted(self._objects)]
        before, self.ids = self.ids, self.selection.excluded(objects, store.url).ids
        written = np.array([change.id for change in changes or ()], dtype=np.int64)
        return bool(np.isin(np.setxor1d(before, self.ids), written).all())

    def _read_again(self, store: Store, ids: set[int]) -> bool:
        """Read written objects; returns whether the words may choose otherwise now."""
        # popped first: a removed object is in no result of the read below
        before = {i: self._objects.pop(i, None) for i in ids}
        now = {obj.id: obj for obj in store.objects(ids)}
        self._objects.update(now)
        return any(_read_by_words(before[i]) != _read_by_words(now.get(i)) for i in ids)


def _read_by_words(obj: Object | None) -> object:
    """Parts of an object for the words of a filter."""
    return None if obj is None else (obj.name, dict(obj.attributes))
