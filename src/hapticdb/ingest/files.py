"""Files -> objects and their rows: one transaction an object, in the order of the file.

Objects are written in the order of the files and of their parts, whatever the number of jobs. So an
import that was interrupted and is run again ends with the same rows and ids as an undisturbed one.
"""

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import (
    EnvironmentExistsError,
    FileError,
    GeometryChangedError,
    HapticDBError,
    MissingExtraError,
    UsageError,
)
from hapticdb.grid import Grid, GridOptions
from hapticdb.ingest.checking import check_inside, check_names
from hapticdb.ingest.known_parts import KnownParts, added_or_present, drop_others, replace_changed
from hapticdb.ingest.voxelizing import voxelize_parts
from hapticdb.mesh import Defects, MeshFile, Part, read_file
from hapticdb.query.quantiles import DEFAULT_RESOLUTION
from hapticdb.store.base import Layout, Object, Store
from hapticdb.store.connect import check_curve, create_store, exists, open_store


class ImportProgress(NamedTuple):
    """How far an import is: sent after each part, and five times a second during a long one.

    share : of the present part, 0 to 1; 0 after a part.
    """

    link: str
    parts_done: int
    parts_total: int
    voxels: int
    share: float = 0.0


ImportCallback = Callable[[ImportProgress], None]


@dataclass(frozen=True)
class FileReport:
    """What became of one file.

    Attributes
    ----------
    link : str
        The file.
    status : {"imported", "complete", "failed"}
        Something was written; everything was there already; nothing was, see `error`.
    added : tuple of Object
        Objects written now, in the file's order.
    present : int
        Objects that were there already.
    restored : int
        Of those written now, parts that had been removed from the environment.
    kept_removed : int
        Parts that were removed and were left out: `ImportOptions.keep_removed`.
    replaced, dropped : int
        Objects that were replaced, and that were removed: `ImportOptions.replace`.
    defects : Defects
        What was wrong in the file.
    error : HapticDBError or None
        Why the file was skipped.
    is_unit_assumed : bool
        Whether neither the file nor the options say a unit, so that its numbers are taken as
        metres.
    """

    link: str
    status: Literal["imported", "complete", "failed"]
    added: tuple[Object, ...] = ()
    present: int = 0
    restored: int = 0
    kept_removed: int = 0
    replaced: int = 0
    dropped: int = 0
    defects: Defects = field(default_factory=Defects)
    error: HapticDBError | None = None
    is_unit_assumed: bool = False


@dataclass(frozen=True)
class ImportOptions:
    """How files are read and voxelized.

    Attributes
    ----------
    unit : str or None
        One of `hapticdb.mesh.UNITS`, of files that carry none; metres unless given.
    grid : GridOptions
        For a new environment; must agree with an existing one.
    layout : {"voxel", "brick"} or None
        For a new environment (bricks unless given); must agree with an existing one.
    jobs : int or None
        Threads that voxelize; one a processor unless given.
    keep_removed : bool
        Leave parts out that were removed from the environment; they come in again otherwise.
    time_limit, memory_limit : float, int or None
        Seconds and bytes that reading one file may take; in proportion to the file unless given,
        see `hapticdb.mesh.read_file`.
    replace : bool
        Make the environment hold what the file holds now: its objects that have another geometry,
        placement or unit there are replaced, under their ids, and those that it lacks are removed.
    """

    unit: str | None = None
    grid: GridOptions = field(default_factory=GridOptions)
    layout: Layout | None = None
    jobs: int | None = None
    keep_removed: bool = False
    time_limit: float | None = None
    memory_limit: int | None = None
    replace: bool = False

    def __post_init__(self) -> None:
        for name, limit in (("seconds", self.time_limit), ("bytes", self.memory_limit)):
            if limit is not None and not 0 < limit < np.inf:
                raise UsageError(f"a limit of {limit} {name}: give a number above 0")
        if self.jobs is not None and self.jobs < 1:
            raise UsageError(f"{self.jobs} jobs: give 1 or more")
        if self.layout is not None and self.grid.curve is not None:
            check_curve(self.grid.curve, self.layout)

    @property
    def limits(self) -> dict[str, Any]:
        """Limits of reading a file that are given, by their names in `read_file`."""
        named = {"time_limit": self.time_limit, "memory_limit": self.memory_limit}
        return {name: limit for name, limit in named.items() if limit is not None}


def import_files(
    url: str | os.PathLike[str],
    files: Sequence[str | os.PathLike[str]],
    options: ImportOptions | None = None,
    progress: ImportCallback | None = None,
) -> list[FileReport]:
    """Import files into an environment, which is made when it does not exist.

    A file that cannot be used is reported and skipped; the others go in. A new environment into
    which nothing went is not left behind.

    Parameters
    ----------
    url : str or path
        The environment: a path, ``sqlite:///path``, or ``postgresql://host/database``.
    files : sequence of paths
        The first usable one decides on the grid of a new environment.
    options : ImportOptions or None
        Units, grid, layout, jobs.
    progress : callable or None
        Called after each part with an `ImportProgress`.

    Returns
    -------
    list of FileReport
        One a file, in order; look at each one's `status`, and at its `error` where that is
        ``failed``.

    Raises
    ------
    GridError, UsageError
        When the options cannot be, or contradict an existing environment.
    DatabaseError
        When the environment cannot be opened or written.
    """
    chosen = options or ImportOptions()
    if isinstance(files, (str, bytes, os.PathLike)):
        raise UsageError(f"files {files!r}: give a list of files")
    if not files:
        raise UsageError("no files: name at least one to import")
    reports: list[FileReport] = []
    with _Target(url, chosen) as target:
        with target.loading:
            for file in files:
                reports.append(_import_file(target, file, chosen, progress))
                target.is_first_file = False
                target.has_written |= bool(reports[-1].added)
        if target.store is not None and target.store.revision():
            target.store.analyze(DEFAULT_RESOLUTION)
    return reports


def _import_file(
    target: "_Target",
    file: str | os.PathLike[str],
    options: ImportOptions,
    progress: ImportCallback | None,
) -> FileReport:
    """Import one file; one that cannot be used gets a report that says why."""
    try:
        mesh_file = read_file(file, unit=options.unit, **options.limits)
        return ingest_file(target.store_for(mesh_file), mesh_file, options, progress)
    except (FileError, MissingExtraError) as error:
        return FileReport(os.fspath(file), "failed", error=error)


class _Target:
    """The environment that files are imported into: opened, or made for the first usable file.

    Attributes
    ----------
    store : Store or None
        None until the environment exists.
    loading : ExitStack
        Holds `Store.loading` from the first file that can be written.
    is_first_file, has_written : bool
        Whether no file came before; whether any object was written.
    """

    def __init__(self, url: str | os.PathLike[str], options: ImportOptions) -> None:
        self._url, self._options = url, options
        self._is_new = self._is_loading = False
        self.loading = contextlib.ExitStack()
        self.is_first_file, self.has_written = True, False
        self.store: Store | None = None
        if not exists(url):
            check_curve(options.grid.curve or "z", options.layout or "brick")
            return
        self.store = open_store(url)
        with _closing_on_error(self.store):
            _check_layout(self.store, options.layout)
            options.grid.check_matches(self.store.grid)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the store; an environment that was made here and got nothing is removed."""
        if self.store is None:
            return
        if self._is_new and not self.has_written and not self.store.revision():
            self.store.discard()
        else:
            self.store.close()

    def store_for(self, mesh_file: MeshFile) -> Store:
        """Give the store, ready to load a file; the first usable file makes the environment."""
        grid_options = self._options.grid
        if self.store is None:
            grid = grid_options.fit(mesh_file.bounds)
            check_inside(mesh_file.parts, mesh_file.link, grid)
            self._create_or_join(grid)
        elif self.is_first_file and not self._is_new:
            grid_options.check_matches(self.store.grid, _first_bounds(self.store, mesh_file))
        assert self.store is not None  # noqa: S101 - opened or made above
        if not self._is_loading:
            self.loading.enter_context(self.store.loading())
            self._is_loading = True
        return self.store

    def _create_or_join(self, grid: Grid) -> None:
        """Make the environment, or open the one that another process has made meanwhile."""
        layout = self._options.layout or "brick"
        try:
            self.store, self._is_new = create_store(self._url, grid, layout), True
        except EnvironmentExistsError:
            store = open_store(self._url)
            with _closing_on_error(store):
                _check_layout(store, layout)
                GridOptions(
                    bits=grid.bits, voxel_size=grid.voxel_size, origin=grid.origin, curve=grid.curve
                ).check_matches(store.grid)
            self.store = store


def ingest_file(
    store: Store,
    mesh_file: MeshFile,
    options: ImportOptions,
    progress: ImportCallback | None = None,
) -> FileReport:
    """Write those parts of a file that the environment does not hold yet.

    Raises
    ------
    OutsideGridError
        When a part leaves the grid; then no part of the file is written.
    GeometryChangedError
        When the environment holds a part of that name with another geometry, unless it is to be
        replaced.
    """
    plan = _planned(store, mesh_file, options)
    jobs = options.jobs or os.cpu_count() or 1
    anew = voxelize_parts(plan.changed.values(), mesh_file, store, options.unit, jobs)
    n_replaced = replace_changed(store, anew, {part.name: i for i, part in plan.changed.items()})
    added = _add_missing(store, mesh_file, plan, (options.unit, jobs), progress)
    n_dropped = drop_others(store, mesh_file) if options.replace else 0
    written = tuple(obj for obj in store.objects() if obj.id in added) if added else ()
    n_kept = len(plan.removed) if options.keep_removed else 0
    return FileReport(
        mesh_file.link,
        "imported" if added or n_replaced or n_dropped else "complete",
        written,
        len(mesh_file.parts) - len(added) - n_kept - n_replaced,
        restored=sum(obj.name in plan.removed for obj in written),
        kept_removed=n_kept,
        replaced=n_replaced,
        dropped=n_dropped,
        defects=mesh_file.defects,
        is_unit_assumed=options.unit is None and not mesh_file.names_unit,
    )


class _Plan(NamedTuple):
    """What is to be done with a file's parts.

    known : parts that the environment holds; missing : parts to add, in the file's order; removed :
    names of the file's parts that were removed from the environment; changed : parts to put in the
    place of objects, by the ids of those.
    """

    known: KnownParts
    missing: list[Part]
    removed: set[str]
    changed: dict[int, Part]


def _planned(store: Store, mesh_file: MeshFile, options: ImportOptions) -> _Plan:
    """Compare a file with the environment; refuses what cannot be written, before any write."""
    check_names(mesh_file)
    known = KnownParts(store, mesh_file.link)
    missing = [part for part in mesh_file.parts if known.digest_of(part.name) is None]
    removed = {part.name for part in missing} & store.removed(mesh_file.link)
    if options.keep_removed:
        missing = [part for part in missing if part.name not in removed]
    for part in mesh_file.parts:
        if known.digest_of(part.name) not in {None, part.digest} and not options.replace:
            raise GeometryChangedError(
                f"{mesh_file.link}: part {part.name!r} has changed since it was imported, or was "
                "read with another --unit; --replace puts the file's in its place"
            )
    changed = known.changed(mesh_file.parts, options.unit) if options.replace else {}
    check_inside([*missing, *changed.values()], mesh_file.link, store.grid)
    return _Plan(known, missing, removed, changed)


def _add_missing(
    store: Store,
    mesh_file: MeshFile,
    plan: _Plan,
    unit_and_jobs: tuple[str | None, int],
    progress: ImportCallback | None,
) -> set[int]:
    """Add the missing parts, but those that another process adds meanwhile; ids of the added."""
    added: set[int] = set()
    n_parts = len(mesh_file.parts)
    n_done = n_parts - len(plan.missing)
    voxels = 0

    def still_missing() -> Iterator[Part]:
        nonlocal n_done
        for part in plan.missing:
            if plan.known.digest_of(part.name) == part.digest:
                n_done += 1  # another process imports the same file
            else:
                yield part

    def report_share(share: float) -> None:
        if progress is not None:
            progress(ImportProgress(mesh_file.link, n_done, n_parts, voxels, share))

    parts = voxelize_parts(still_missing(), mesh_file, store, *unit_and_jobs, report_share)
    for obj, rows in parts:
        n_done += 1
        if (new_id := added_or_present(store, obj, rows, plan.known)) is not None:
            added.add(new_id)
        voxels += obj.voxels
        report_share(0.0)
    return added


def _check_layout(store: Store, layout: Layout | None) -> None:
    if layout is not None and layout != store.layout:
        raise UsageError(
            f"{store.url} has the layout {store.layout}, not {layout}; leave --layout out"
        )


def _first_bounds(store: Store, mesh_file: MeshFile) -> NDArray[np.float64] | None:
    """Bounds of a file if it is the one that decided on the grid: `--extent` is meant for it."""
    first = next(iter(store.objects()), None)
    if first is None or first.link == mesh_file.link:
        return mesh_file.bounds
    return None


@contextlib.contextmanager
def _closing_on_error(store: Store) -> Iterator[None]:
    """Close a store when the block raises."""
    try:
        yield
    except BaseException:
        store.close()
        raise
