"""Integrity check of an environment: stored data against its sources, and the repair."""

import os
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from hapticdb.clashes.pair_check import pair_faults
from hapticdb.errors import DamagedError
from hapticdb.grid import BRICK_BITS, Grid
from hapticdb.ingest.geometry import unpacked_part
from hapticdb.ingest.object_moves import rewrite_object
from hapticdb.ingest.placement import OTHER_BOUNDS, placement_faults
from hapticdb.kernels import curves
from hapticdb.kernels.field import packing
from hapticdb.kernels.surfaces import voxelize
from hapticdb.store.base import (
    BRICK_BYTES,
    Band,
    Change,
    Keys,
    Object,
    Progress,
    Rows,
    Store,
    all_rows,
    is_ascending,
    row_shift,
)
from hapticdb.store.connect import open_store
from hapticdb.store.engines import DropsRows
from hapticdb.store.pairs import PairRow
from hapticdb.store.parsing import Checksum, cause_of

ROWS_AT_ONCE = 1 << 14
"""Rows of a batch; 1,000 bytes each with unpacked distances."""
MOST_FINDINGS = 1000
"""Findings in a report, at most; it counts all of them."""


@dataclass
class CheckReport:
    """Result of a check.

    url : the environment, as in messages
    findings : one line for each fault, at most the first `MOST_FINDINGS`
    n_findings : number of all faults
    objects, voxels, rows, surfaces : numbers of objects, voxels, rows and surfaces read
    wrong : ids of objects with other rows, distances or bounds than written
    orphans : ids of rows or distances without an object
    pairs : rows of pairs that contradict their surfaces
    lacks_pairs : whether rows of pairs are missing
    """

    url: str
    findings: list[str] = field(default_factory=list)
    n_findings: int = 0
    objects: int = 0
    voxels: int = 0
    rows: int = 0
    surfaces: int = 0
    wrong: list[int] = field(default_factory=list)
    orphans: list[int] = field(default_factory=list)
    pairs: list[PairRow] = field(default_factory=list)
    lacks_pairs: bool = False

    def __repr__(self) -> str:
        found = f"{self.n_findings} faults" if self.n_findings else "sound"
        return f"CheckReport({found}, {self.objects} objects, {self.voxels} voxels, {self.url!r})"

    @property
    def is_sound(self) -> bool:
        """Whether the environment has no fault."""
        return self.n_findings == 0

    @property
    def is_mendable(self) -> bool:
        """Whether `repair_environment` can mend some of it."""
        return bool(self.wrong or self.orphans or self.pairs or self.lacks_pairs)

    def add(self, finding: str) -> None:
        """Add a finding, unless the report has it already."""
        if finding in self.findings:
            return
        self.n_findings += 1
        if len(self.findings) < MOST_FINDINGS:
            self.findings.append(finding)


def check_environment(
    url: str | os.PathLike[str], *, progress: Progress | None = None
) -> CheckReport:
    """Read all of an environment and report its faults.

    The engine checks its own structure. Every row must belong to an object, be in order, and lie in
    the grid and in its object's bounds. A brick must contain a voxel, and none outside the grid.
    Every object must have its number of voxels, the checksums of its rows and distances, and
    distances in every brick with a voxel. Every surface must have its digest and an object, whose
    bounds and voxels are at its transform, within the grid. Every pair is judged again. The log of
    changes must have no gaps and agree with the objects. Memory is independent of the number of
    rows.

    progress : called after each batch with the rows read, and their total.

    Raises `DatabaseError` if the environment is unreadable for another reason than damage.
    """
    report = CheckReport(os.fspath(url))
    try:
        with closing(open_store(url, read_only=True)) as store:
            report.url = store.url
            _check(store, report, progress)
    except DamagedError as error:
        report.add(cause_of(error))
    return report


def repair_environment(
    url: str | os.PathLike[str], report: CheckReport, *, progress: Progress | None = None
) -> None:
    """Mend the faults of rows and pairs in a report: a transaction an object.

    Wrong rows and bounds are recomputed from the object's surface. Rows without an object, the
    result of a crash between the servers of partitions, are removed. Pairs are marked for the next
    search for clashes; they stay accepted.
    """
    with closing(open_store(url)) as store:
        total = len(report.wrong) + len(report.orphans)
        for n, object_id in enumerate(report.orphans):
            if isinstance(store, DropsRows):
                store.drop_rows(object_id)
            if progress is not None:
                progress(n + 1, total)
        for n, object_id in enumerate(report.wrong, start=len(report.orphans)):
            rewrite_object(store, store.object(object_id))
            if progress is not None:
                progress(n + 1, total)
        if report.pairs or report.lacks_pairs:
            _mark_pairs(store, report.pairs)


def _mark_pairs(store: Store, wrong: list[PairRow]) -> None:
    """Mark pairs as of no search: the next one measures them, and all missing ones."""
    there, revision = {obj.id for obj in store.objects()}, store.revision()
    gone = [row for row in wrong if row.revision > revision or not {row.a, row.b} <= there]
    anew = [row._replace(setting="", revision=revision) for row in wrong if row not in gone]
    store.put_pairs(anew, [(row.a, row.b) for row in gone])
    for row in anew:
        if row.because is None or row.shapes is None:
            store.accept_pair(row.a, row.b, None, None)


def _check(store: Store, report: CheckReport, progress: Progress | None) -> None:
    with store.snapshot():
        try:
            for finding in store.findings():
                report.add(finding)
            objects = {obj.id: obj for obj in store.objects()}
        except DamagedError as error:
            report.add(cause_of(error))
            return
        report.objects = len(objects)
        if not store.wants_distances and any(obj.has_distances for obj in objects.values()):
            report.add("objects have distances, and the environment wants none")
        for finding in chain(
            _log_findings(store, objects),
            _row_findings(store, objects, report, progress),
            _surface_findings(store, objects, report),
        ):
            report.add(finding)
        try:
            for fault in pair_faults(store, objects):
                report.add(fault.text)
                report.lacks_pairs |= fault.row is None
                report.pairs += [fault.row] if fault.row else []
            store.rules()
        except DamagedError as error:
            report.add(cause_of(error))


# -- the log of changes --------------------------------------------------------------------------


def _log_findings(store: Store, objects: dict[int, Object]) -> Iterator[str]:
    """Gaps in the log of changes, and objects at variance with it."""
    last: dict[int, Change] = {}
    expected = 1
    key_end = 1 << 3 * store.grid.bits
    for change in store.changes():
        if change.revision != expected:
            yield f"changes {expected} to {change.revision - 1} are missing from the log"
        expected = change.revision + 1
        if change.ranges.size and int(change.ranges.max()) >= max(key_end, 1 << 15):
            yield f"change {change.revision} tells of keys outside the grid"
        last[change.id] = change
    if store.revision() != expected - 1:
        yield f"the revision is {store.revision()}, the log ends with {expected - 1}"
    for object_id, change in last.items():
        obj = objects.get(object_id)
        if change.action == "remove" and obj is not None:
            yield f"object {object_id} is there, though change {change.revision} removed it"
        if change.action != "remove" and obj is None:
            yield f"object {object_id} is gone, though nothing removed it"
        if change.action != "remove" and obj is not None and obj.revision != change.revision:
            yield (
                f"object {object_id} is of revision {obj.revision}, its last change of "
                f"{change.revision}"
            )
    for object_id in objects.keys() - last.keys():
        yield f"object {object_id} is there, though nothing added it"


# -- rows ----------------------------------------------------------------------------------------


class _Sum:
    """Voxel counts and checksums of an object, over the rows so far."""

    def __init__(self) -> None:
        self.voxels = self.voxels_measured = self.rows_measured = 0
        self.rows, self.distances = Checksum(), Checksum()

    def add(self, rows: Rows) -> None:
        """Add rows of the object: voxels, or bricks with distances."""
        held, measured = rows.occupied(), rows.measured()
        self.voxels += _voxels_of(held)
        self.voxels_measured += _voxels_of(measured)
        self.rows_measured += len(measured)
        self.rows.add(held)
        self.distances.add(measured)


def _voxels_of(rows: Rows) -> int:
    return voxelize.count_voxels(rows.occupancy) if rows.occupancy.size else len(rows)


class _Sums:
    """Sums of each object, from the rows read so far."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.of: defaultdict[int, _Sum] = defaultdict(_Sum)
        self.disorder: str | None = None

    def batches(self) -> Iterator[Rows]:
        """All rows, added to the sums; ends at the first `disorder`."""
        key, object_id = -1, 0
        for rows in all_rows(self._store, ROWS_AT_ONCE):
            if not is_ascending(np.append(key, rows.keys), np.append(object_id, rows.ids)):
                self.disorder = f"after key {key} are not in order"
                return
            key, object_id = int(rows.keys[-1]), int(rows.ids[-1])
            self._add(rows)
            yield rows

    def _add(self, rows: Rows) -> None:
        order = np.argsort(rows.ids, kind="stable")
        ids = rows.ids[order]
        starts = np.flatnonzero(np.diff(ids, prepend=ids[0] - 1))
        for own in np.split(order, starts[1:]):
            self.of[int(rows.ids[own[0]])].add(rows.picked(own))


def _row_findings(
    store: Store,
    objects: dict[int, Object],
    report: CheckReport,
    progress: Progress | None,
) -> Iterator[str]:
    sums, places, total = _Sums(store), _Places(store, objects), store.size().rows
    for rows in sums.batches():
        report.rows += len(rows)
        yield from places.findings(rows)
        yield from _band_findings(rows.measured())
        if progress is not None:
            progress(min(report.rows, total), total)
    if sums.disorder:
        yield f"rows {sums.disorder}"
        return
    report.voxels = sum(one.voxels for one in sums.of.values())
    if report.rows != total:
        yield f"{report.rows:,} rows were read, and {total:,} counted"
    report.orphans = sorted(sums.of.keys() - objects.keys())
    for missing in report.orphans:
        yield f"rows of object {missing}, which is not there"
    for obj in objects.values():
        faults = list(_faults_of(obj, sums.of[obj.id]))
        yield from (f"object {obj.id} ({obj.name}){fault}" for fault in faults)
        if faults:
            report.wrong.append(obj.id)


def _band_findings(rows: Rows) -> Iterator[str]:
    """Faults of packed distances."""
    assert rows.distances is not None  # noqa: S101 - of measured rows
    try:
        packing.unpack(*rows.distances)
    except ValueError as error:
        first, last = rows.keys[[0, -1]].tolist()
        yield f"distances between keys {first} and {last}: {error}"


def _faults_of(obj: Object, found: _Sum) -> Iterator[str]:
    """Faults of an object's rows."""
    if found.voxels != obj.voxels:
        yield f" has {found.voxels:,} voxels instead of {obj.voxels:,}"
    if found.rows.value() != obj.rows_crc:
        yield ": its rows are not those that were written"
    if not obj.has_distances:
        if found.rows_measured:
            yield " has distances, and its record has none"
        return
    if found.voxels_measured != obj.voxels:
        yield " has voxels in bricks without distances"
    if found.distances.value() != obj.distances_crc:
        yield ": its distances are not those that were written"


# -- surfaces -------------------------------------------------------------------------------------


def _surface_findings(
    store: Store, objects: dict[int, Object], report: CheckReport
) -> Iterator[str]:
    """Surfaces that are damaged, missing, misplaced, or without an object."""
    of_digest: dict[str, list[Object]] = {}
    for obj in objects.values():
        of_digest.setdefault(obj.digest, []).append(obj)
    there = store.surface_digests()
    for digest in sorted(there - of_digest.keys()):
        yield f"surface {digest:.40} of no object"
    for obj in objects.values():
        if obj.digest not in there:
            yield f"object {obj.id} ({obj.name}) has no surface"
    for digest in sorted(there & of_digest.keys()):
        report.surfaces += 1
        same = of_digest[digest]
        try:
            shape = unpacked_part(store.url, same[0], store.surfaces([digest])[digest])
        except DamagedError as error:
            yield cause_of(error)
            continue
        for obj in same:
            part = replace(shape, name=obj.name, world_from_part=obj.transform)
            found = list(placement_faults(store, obj, part))
            if found == [OTHER_BOUNDS] and obj.id not in report.wrong:
                report.wrong.append(obj.id)
            yield from (f"object {obj.id} ({obj.name}): {fault}" for fault in found)


class _Places:
    """Permitted keys of rows: within the grid, and within the bounds of their objects."""

    def __init__(self, store: Store, objects: dict[int, Object]) -> None:
        grid = store.grid
        self._grid, self._is_brick = grid, store.layout == "brick"
        self._key_end = 1 << max(3 * grid.bits - row_shift(store.layout), 0)
        self._ids = np.array(sorted(objects), dtype=np.int64)
        boxes = [_voxel_box(grid, objects[i]) for i in self._ids.tolist()]
        self._boxes = np.array(boxes, dtype=np.int64).reshape(-1, 2, 3)

    def findings(self, rows: Rows) -> Iterator[str]:
        """Faults in the keys of a batch: the first row of each kind of fault."""
        outside = (rows.keys < 0) | (rows.keys >= self._key_end)
        if outside.any():
            yield f"key {int(rows.keys[outside][0])} lies outside the grid"
        if rows.distances is not None:
            yield from self._brick_findings(rows, rows.distances)
        rows = rows.picked(np.flatnonzero(~outside & np.isin(rows.ids, self._ids))).occupied()
        low = self._voxels(rows.keys)
        box = self._boxes[np.searchsorted(self._ids, rows.ids)]
        size = (1 << BRICK_BITS) - 1 if self._is_brick else 0
        beside = ((low > box[:, 1]) | (low + size < box[:, 0])).any(axis=1)
        for object_id in np.unique(rows.ids[beside]).tolist():
            yield f"object {object_id}: rows of it lie outside its bounds"

    def _brick_findings(self, rows: Rows, distances: Band) -> Iterator[str]:
        bricks = rows.occupancy.reshape(-1, BRICK_BYTES)
        empty = ~bricks.any(axis=1) & (distances.lengths == 0)
        if empty.any():
            yield f"brick {int(rows.keys[empty][0])} holds no voxel"
        if self._grid.bits < BRICK_BITS:  # the grid is smaller than a brick: its first voxels
            held = np.unpackbits(bricks, axis=1, bitorder="little")
            if held[:, 1 << 3 * self._grid.bits :].any():
                yield "a brick holds voxels outside the grid"

    def _voxels(self, keys: Keys) -> NDArray[np.int64]:
        """Lowest voxels (n, 3) of rows."""
        grid = self._grid
        if not self._is_brick:
            return grid.decode(keys)
        level = max(grid.bits - BRICK_BITS, 0)
        return np.asarray(curves.decode(keys, level, grid.curve_code) << BRICK_BITS)


def _voxel_box(grid: Grid, obj: Object) -> NDArray[np.int64]:
    """Lowest and highest voxel (2, 3) of an object's bounds, with a margin of a voxel."""
    with np.errstate(invalid="ignore", over="ignore"):
        places = (obj.bounds - np.array(grid.origin)) / grid.voxel_size
    box = np.floor(places.clip(-1.0, grid.side)).astype(np.int64)
    return np.asarray(box + np.array([[-1], [1]]))
