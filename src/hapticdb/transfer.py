"""Copies environments between engines, layouts and curves."""

from collections.abc import Iterable
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hapticdb.errors import (
    ConflictError,
    DamagedError,
    EnvironmentExistsError,
    GridError,
    UsageError,
)
from hapticdb.grid import CurveName, Grid
from hapticdb.ingest.geometry import bricks_of_batches, rows_of_object
from hapticdb.ingest.layout import rows_of_bricks
from hapticdb.kernels.surfaces import voxelize
from hapticdb.paper.quantiles import DEFAULT_RESOLUTION, QuantileVector
from hapticdb.store.base import Layout, Object, Progress, Rows, Store, joined
from hapticdb.store.connect import create_store, exists, open_store
from hapticdb.store.engines import Url
from hapticdb.store.parsing import Checksum


@dataclass(frozen=True)
class CopyReport:
    """Result of a copy.

    source, target : the environments, as in messages, without a password
    copied, voxels : objects written now, and their voxels
    present : objects in the target before
    renumbered : objects written with another id, because their own was in use
    """

    source: str
    target: str
    copied: int
    voxels: int
    present: int
    renumbered: int


def copy_environment(
    source_url: Url, target_url: Url, *, layout: Layout | None = None,
    curve: CurveName | None = None, progress: Progress | None = None,
) -> CopyReport:  # fmt: skip
    """Copy an environment's objects into another, made if it does not exist.

    Each object is copied in one transaction, with its id if that is free, its surface, and its
    distances if the target stores them; a new target of bricks does if the source does. Objects
    already in the target are skipped, so an interrupted copy can be continued by the same call.
    Everything is read at one revision. Memory is proportional to the largest object.

    layout : of a new target, by default the source's; must be that of an existing one
    curve : by the same rule
    progress : called after each written object with the number of objects done, and of all

    Raises `UsageError` or `GridError` for two URLs of one environment, for bricks in lexicographic
    order, or for a target with another grid, layout or curve; `ConflictError`, before any write,
    for a part with another geometry or transform in the target; `DamagedError` for an object of the
    source with another number of voxels than its record.
    """
    with closing(open_store(source_url, read_only=True)) as source:
        target, is_new = _target(target_url, source, layout, curve)
        is_copied = False
        try:
            report = _copy_objects(source, target, progress)
            is_copied = True
            if target.revision():
                target.analyze(DEFAULT_RESOLUTION)
        finally:
            if is_new and not is_copied and not target.revision():
                target.discard()
            else:
                target.close()
    return report


def _target(
    url: Url, source: Store, layout: Layout | None, curve: CurveName | None
) -> tuple[Store, bool]:
    """Open or make the target; the flag: whether it was made."""
    if not exists(url):
        grid = source.grid if curve is None else replace(source.grid, curve=curve)
        with suppress(EnvironmentExistsError):  # another process may be faster
            kept = layout or source.layout
            distances = kept == "brick" and source.wants_distances
            return create_store(url, grid, kept, distances=distances), True
    store = open_store(url)
    with ExitStack() as on_error:
        on_error.callback(store.close)
        if _is_same_place(source, store):
            raise UsageError(f"{source.url} and {store.url} are one: copy to another place")
        if not is_same_grid(source.grid, store.grid):
            raise GridError(
                f"{store.url} has another grid ({store.grid.describe()}) than {source.url} "
                f"({source.grid.describe()}): copy into a new environment"
            )
        there = (("layout", layout, store.layout), ("curve", curve, store.grid.curve))
        for word, wanted, found in there:
            if wanted not in {None, found}:
                raise UsageError(
                    f"{store.url} has the {word} {found}, not {wanted}; leave --{word} out, or "
                    "copy into a new environment"
                )
        on_error.pop_all()
    return store, False


def _is_same_place(a: Store, b: Store) -> bool:
    """Whether two URLs refer to one environment, also through links of the file system."""
    with suppress(OSError, ValueError):
        return Path(a.url).samefile(b.url)
    return a.url == b.url


def is_same_grid(a: Grid, b: Grid) -> bool:
    """Whether two grids divide space into the same voxels."""
    return (a.voxel_size, a.origin, a.bits) == (b.voxel_size, b.origin, b.bits)


def _copy_objects(source: Store, target: Store, progress: Progress | None) -> CopyReport:
    copied = voxels = renumbered = 0
    # loading ends after the source's snapshot: an engine cannot vacuum tables that are being read
    with ExitStack() as loading, source.snapshot():
        objects = source.objects()
        missing = _missing(objects, source, target)
        quantiles = QuantileVector.of(source)
        if missing:
            loading.enter_context(target.loading())
        for done, obj in enumerate(missing, start=len(objects) - len(missing) + 1):
            rows = _rows_for(target, source, obj, quantiles)
            surface = source.surfaces([obj.digest]).get(obj.digest)
            try:
                renumbered += target.add(obj, rows, surface) != obj.id
            except EnvironmentExistsError:
                if _missing([obj], source, target):
                    raise
                continue  # another process copies the same
            copied += 1
            voxels += obj.voxels
            if progress is not None:
                progress(done, len(objects))
    if rules := source.rules():
        target.change_rules(lambda now: now or rules)
    present = len(objects) - copied
    return CopyReport(source.url, target.url, copied, voxels, present, renumbered)


def _missing(objects: Iterable[Object], source: Store, target: Store) -> list[Object]:
    """Objects absent from the target; ConflictError for one at variance with the target's."""
    known = {part_of(obj): obj for obj in target.objects()}
    taken = {obj.id for obj in known.values()}
    missing = []
    for obj in objects:
        there = known.get(part_of(obj))
        if there is None:
            missing.append(obj)
            continue
        if obj.digest != there.digest:
            word = "with another geometry"
        elif not np.array_equal(obj.transform, there.transform):
            word = "in another place"
        elif obj.voxels != there.voxels:
            word = f"with {there.voxels} voxels instead of {obj.voxels}"
        else:
            continue
        raise ConflictError(
            f"object {obj.id} ({obj.name}) of {source.url} is in {target.url} {word}: remove "
            f"object {there.id} there, or copy into a new environment"
        )
    # objects that need a new id come last: a new id must not be the id of a later object
    return sorted(missing, key=lambda obj: (obj.id in taken, obj.id))


def part_of(obj: Object) -> tuple[str, str]:
    """Identity of a part across environments: link and name."""
    return obj.link, obj.name


def _rows_for(target: Store, source: Store, obj: Object, quantiles: QuantileVector) -> Rows:
    """All rows of an object of the source, in the layout and curve of the target."""
    distances = obj.has_distances and target.wants_distances
    batches = list(rows_of_object(source, obj, quantiles, distances=distances))
    if distances:
        checksum = Checksum()
        for batch in batches:
            checksum.add(batch)
        if checksum.value() != obj.distances_crc:
            raise _damaged(source, obj, "distances other than those that were written")
    if (source.layout, source.grid.curve) == (target.layout, target.grid.curve):
        rows = joined(batches, distances=distances)
        n_voxels = len(rows) if source.layout == "voxel" else voxelize.count_voxels(rows.occupancy)
    else:
        bricks = bricks_of_batches(source, batches, distances=distances)
        rows, n_voxels = rows_of_bricks(bricks, target.grid, target.layout)
    if n_voxels != obj.voxels:
        raise _damaged(source, obj, f"{n_voxels} voxels instead of {obj.voxels}")
    return rows


def _damaged(source: Store, obj: Object, what: str) -> DamagedError:
    return DamagedError(
        f"{source.url} is damaged (object {obj.id}, {obj.name}, has {what}): remove that object "
        "and import its file again, or restore a copy"
    )
