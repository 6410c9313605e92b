"""Ids of the objects that the tools touch: loops request them, the fetching process answers."""

from collections.abc import Iterable

import numpy as np

from hapticdb.kernels.field.law import ONSET
from hapticdb.kernels.records import MOST_ASKED
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.store.base import Keys, Store
from hapticdb.store.objects_at import ids_near_voxels, ids_of_voxels

NEAR = ONSET + 0.87
"""Voxels within which an object is felt, where cells have distances: the onset of the smooth law,
and half a voxel's diagonal, since the distance counts at the centre of the voxel that holds the
point. Larger: objects are named that are not felt."""


class ObjectAnswers:
    """Answers on the desk of a table: ids of the objects that are felt in the voxels asked for.

    These are the objects in the voxels; in a table with distances, those near the voxels, too.

    Parameters
    ----------
    table : CellTable
        Table of the sessions.
    residency : Residency
        Its cells; objects that are left out of them are left out of the answers.
    """

    def __init__(self, table: CellTable, residency: Residency) -> None:
        self._desk = table.desk.sessions
        self._residency = residency
        self._has_distances = table.has_distances
        self._answered: dict[int, bytes] = {}

    def forget(self) -> None:
        """Forget all answers, so that every request is answered again: the database has changed."""
        self._answered.clear()

    def answer(self, store: Store, rows: Iterable[int]) -> None:
        """Answer the sessions in `rows` whose requests have changed since the last answer."""
        before, self._answered = self._answered, {}
        for row in rows:
            n_asked = int(self._desk["n_asked"][row])
            if n_asked <= 0:
                self._desk["n_objects"][row] = 0
                continue
            keys = np.unique(self._desk["asked"][row, :n_asked])
            question = keys.tobytes()
            if before.get(row) != question:
                ids = self.ids_of(store, keys)[:MOST_ASKED]
                self._desk["objects"][row, : len(ids)] = ids
                self._desk["n_objects"][row] = len(ids)
            self._answered[row] = question

    def ids_of(self, store: Store, keys: Keys) -> Keys:
        """Ids of the objects that are felt in voxels (n,), distinct and ascending."""
        exclude = self._residency.exclude
        if self._has_distances:
            return ids_near_voxels(store, keys, exclude, NEAR)
        return ids_of_voxels(store, keys, exclude)
