"""Objects whose rows tell which version of them they are, so that a torn one shows by itself.

Each row of an object carries the object's label, and its keys follow from the label. So a reader
who gets rows of two versions, or not all rows of one, knows without asking anybody.
"""

from functools import lru_cache

import numpy as np

from hapticdb import Grid
from hapticdb.kernels.field import packing
from hapticdb.kernels.field.lattice import ROW_VALUES
from hapticdb.store.base import BRICK_BYTES, Band, Object, Rows, Store
from hapticdb.testing.scenes import EVERYWHERE

GRID = Grid(0.005, (0, 0, 0), 7)
N_KEYS = 1 << 3 * GRID.bits - 9
"""Bricks of the grid. Objects lie all over them, so on all shards."""
Labels = dict[int, int]
"""Label of each object by its id: all that is to know of an environment of such objects."""


class TornError(AssertionError):
    """A read that shows no version of an object."""


@lru_cache(maxsize=256)
def labelled_rows(label: int) -> Rows:
    """Rows of the object of a label; every third label is without distances."""
    rng = np.random.default_rng(label)
    keys = np.sort(rng.choice(N_KEYS, 40, replace=False)).astype(np.int64)
    bricks = rng.integers(0, 256, (len(keys), BRICK_BYTES), dtype=np.uint8)
    bricks[:, :8] = np.frombuffer(np.int64(label).tobytes(), np.uint8)
    ids = np.zeros(len(keys), np.int64)
    rows = Rows(keys, ids, bricks.reshape(-1))
    if label % 3 == 0:
        return rows
    steps = rng.integers(100, 140, (len(keys), ROW_VALUES), dtype=np.uint8)
    return rows.having(Band(*packing.pack(steps)))


def labelled_object(label: int, object_id: int = 0, name: str = "") -> Object:
    """Record of the object of a label; its digest is the label."""
    bits = np.unpackbits(labelled_rows(label).occupancy)
    return Object(
        name=name or f"labelled {label}",
        link="made",
        digest=str(label),
        transform=np.eye(4),
        voxels=int(bits.sum()),
        bounds=np.array([[0.0] * 3, [GRID.side * GRID.voxel_size] * 3]),
        id=object_id,
    )


def labels_of(rows: Rows, *, distances: bool = False) -> Labels:
    """Labels of the objects in all rows of a scan; each object must be whole, in one version.

    Raises
    ------
    TornError
        When rows of an object are missing, or are of two versions.
    """
    found: Labels = {}
    bricks = rows.occupancy.reshape(-1, BRICK_BYTES)
    for object_id in np.unique(rows.ids).tolist():
        which = np.flatnonzero(rows.ids == object_id)
        labels = bricks[which, :8].copy().view(np.int64).reshape(-1)
        label = int(labels[0])
        expected = labelled_rows(label)
        own = rows.picked(which)
        if (labels != label).any() or not np.array_equal(own.keys, expected.keys):
            raise TornError(f"object {object_id} has rows of {sorted(set(labels.tolist()))}")
        if not np.array_equal(own.occupancy, expected.occupancy):
            raise TornError(f"object {object_id} has other bits than {label}")
        if distances:
            assert own.distances is not None
            assert expected.distances is not None
            if own.distances.data.tobytes() != expected.distances.data.tobytes():
                raise TornError(f"object {object_id} has other distances than {label}")
        found[object_id] = label
    return found


def contents_of(store: Store) -> Labels:
    """Labels of all objects at one revision; objects, rows and distances must agree.

    Raises
    ------
    TornError
        When they do not.
    """
    with store.snapshot():
        recorded = {obj.id: int(obj.digest) for obj in store.objects()}
        found = labels_of(store.scan(*EVERYWHERE))
        banded = labels_of(store.scan(*EVERYWHERE, distances=True), distances=True)
        count = store.count(*EVERYWHERE)
    if found != recorded:
        raise TornError(f"the objects are {recorded}, their rows {found}")
    if banded != {i: label for i, label in recorded.items() if label % 3}:
        raise TornError(f"the objects are {recorded}, those with distances {banded}")
    if count != sum(len(labelled_rows(label)) for label in recorded.values()):
        raise TornError(f"{count} rows are counted")
    return recorded
