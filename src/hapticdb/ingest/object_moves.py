"""Moves of objects: voxelization of their surfaces at the new placement, and new rows."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.ingest.geometry import parts_of, unpacked_part
from hapticdb.ingest.planning import bounds_inside
from hapticdb.ingest.voxelizing import rows_of_part
from hapticdb.mesh import Part
from hapticdb.poses import as_floats
from hapticdb.query.haptic_query import as_ids
from hapticdb.store.base import Object, Rows, Store

Floats = NDArray[np.float64]


def move_object(store: Store, old: Object, transform: ArrayLike, revision: int | None) -> None:
    """Move an object; see `Environment.move`."""
    placed = _as_transform(transform)
    ((_, part),) = parts_of(store, [old])
    new, rows = _moved(store, old, part, placed)
    store.replace(replace(new, revision=revision or 0), rows)


def restore_object(store: Store, record: Object) -> int:
    """Write a removed object again, with its placement and id; see `Environment.restore`."""
    surface = record.surface or store.surfaces([record.digest]).get(record.digest)
    if surface is None:
        raise UsageError(
            f"object {record.id} ({record.name}) cannot be put back: give what 'remove' returned, "
            "which has its surface"
        )
    part = unpacked_part(store.url, record, surface)
    new, rows = _moved(store, record, part, record.transform)
    return store.add(replace(new, surface=None), rows, surface)


def rewrite_object(store: Store, obj: Object) -> None:
    """Write an object's rows anew from its surface; deletes old rows outside its bounds, too."""
    ((_, part),) = parts_of(store, [obj])
    store.replace(*_moved(store, obj, part, obj.transform), everywhere=True)


def shift_objects(store: Store, ids: Iterable[int], translation: ArrayLike) -> list[Object]:
    """Translate objects by one vector; see `Environment.shift`."""
    shift = np.eye(4)
    shift[:3, 3] = _as_translation(translation)
    chosen = as_ids(ids).tolist()

    def moved() -> Iterator[tuple[Object, Rows]]:
        objects = [store.object(i) for i in chosen]
        for obj, part in parts_of(store, objects):  # all, before the first is voxelized
            bounds_inside(part, obj.link, store.grid, shift @ obj.transform)
        for obj, part in parts_of(store, objects):
            yield _moved(store, obj, part, shift @ obj.transform)

    if chosen:
        store.replace_all(moved)
    return [store.object(i) for i in chosen]


def _moved(store: Store, old: Object, part: Part, placed: Floats) -> tuple[Object, Rows]:
    """Record and rows of an object with its part at the placement `placed` (4, 4)."""
    bounds = bounds_inside(part, old.link, store.grid, placed)
    rows, n_voxels = rows_of_part(
        part, store.grid, store.layout, placed, distances=old.has_distances
    )
    new = replace(
        old,
        transform=placed,
        voxels=n_voxels,
        bounds=bounds,
        revision=0,
        rows_crc=None,
        distances_crc=None,
    )
    return new, rows


def _as_translation(translation: ArrayLike) -> Floats:
    shift = as_floats(translation, "a translation")
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise UsageError("no translation: give three finite numbers x, y, z in metres")
    return shift


def _as_transform(transform: ArrayLike) -> Floats:
    placed = as_floats(transform, "a transform").copy()
    if placed.shape != (4, 4) or not np.isfinite(placed).all() or (placed[3] != (0, 0, 0, 1)).any():
        raise UsageError("a transform that is no placement: give a finite 4 x 4 matrix in metres")
    if np.linalg.matrix_rank(placed[:3, :3]) < 3:
        raise UsageError("a transform that flattens the object: give one that can be undone")
    return placed
