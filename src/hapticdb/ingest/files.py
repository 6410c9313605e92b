"""Parts -> voxels -> rows: parallel over parts, one transaction an object, in the file's order.

Threads suffice: the voxelizer and the engine both run without the interpreter lock. Objects are
written in the order of the files and of their parts, whatever the number of jobs, so that an
interrupted import that is run again ends with the same rows and ids as an undisturbed one.
"""

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import (
    EnvironmentExistsError,
    FileError,
    GeometryChangedError,
    HapticDBError,
    MissingExtraError,
    OutsideGridError,
    UsageError,
)
from hapticdb.grid import Grid, GridOptions
from hapticdb.ingest.known_parts import KnownParts, added_or_present, drop_others, replace_changed
from hapticdb.ingest.voxelizing import ShareCallback, rows_of_part
from hapticdb.mesh import Defects, MeshFile, Part, read_file
from hapticdb.query.quantiles import DEFAULT_RESOLUTION
from hapticdb.store.base import Layout, Object, Rows, Store
from hapticdb.store.connect import check_curve, create_store, exists, open_store

AT_BORDER = 1e-6
"""Voxels by which rounding may carry a part across the grid's border without an error."""
EVERY = 0.2
"""Seconds after which the share of a part that takes long is told again."""


class ImportProgress(NamedTuple):
    """How far an import is: sent after each part, and five times a second while one takes long.

    share: of the part that is waited for, 0 to 1; 0 after a part.
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
        Parts that were removed, and stay so: `ImportOptions.keep_removed`.
    replaced, dropped : int
        Objects that are another now, and that are gone: `ImportOptions.replace`.
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
        Called after each part with a `ImportProgress`.

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
    store = open_store(url) if exists(url) else None
    if store is None:
        check_curve(chosen.grid.curve or "z", chosen.layout or "brick")
    else:
        with _closing_on_error(store):
            _check_layout(store, chosen.layout)
            chosen.grid.check_matches(store.grid)
    is_new = False
    reports: list[FileReport] = []
    n_written = 0
    try:
        is_loading = False
        with contextlib.ExitStack() as loading:
            for n, file in enumerate(files):
                try:
                    mesh_file = read_file(file, unit=chosen.unit, **chosen.limits)
                    if store is None:
                        grid = chosen.grid.fit(mesh_file.bounds)
                        _check_inside(mesh_file, grid)
                        store, is_new = _created_or_joined(url, grid, chosen)
                    elif n == 0 and not is_new:
                        chosen.grid.check_matches(store.grid, _first_bounds(store, mesh_file))
                    if not is_loading:
                        loading.enter_context(store.loading())
                        is_loading = True
                    report = ingest_file(store, mesh_file, chosen, progress)
                except (FileError, MissingExtraError) as error:
                    report = FileReport(os.fspath(file), "failed", error=error)
                n_written += len(report.added)
                reports.append(report)
        if store is not None and store.revision():
            store.analyze(DEFAULT_RESOLUTION)
    finally:
        if store is not None:
            if is_new and not n_written and not store.revision():
                store.discard()
            else:
                store.close()
    return reports


def _created_or_joined(
    url: str | os.PathLike[str], grid: Grid, options: ImportOptions
) -> tuple[Store, bool]:
    """Make the environment, or join one that another has made meanwhile; whether it was made."""
    try:
        return create_store(url, grid, options.layout or "brick"), True
    except EnvironmentExistsError:
        store = open_store(url)
        with _closing_on_error(store):
            _check_layout(store, options.layout or "brick")
            GridOptions(
                bits=grid.bits, voxel_size=grid.voxel_size, origin=grid.origin, curve=grid.curve
            ).check_matches(store.grid)
        return store, False


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
    _check_names(mesh_file)
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
    jobs = options.jobs or os.cpu_count() or 1
    changed = known.changed(mesh_file.parts, options.unit) if options.replace else {}
    _check_inside(mesh_file, store.grid, [*missing, *changed.values()])
    anew = _voxelized(changed.values(), mesh_file, store, options.unit, jobs)
    n_replaced = replace_changed(store, anew, {part.name: i for i, part in changed.items()})
    added: set[int] = set()
    n_parts = len(mesh_file.parts)
    n_kept = len(removed) if options.keep_removed else 0
    n_done = n_parts - len(missing)
    voxels = 0

    def still_missing() -> Iterator[Part]:
        nonlocal n_done
        for part in missing:
            if known.digest_of(part.name) == part.digest:
                n_done += 1  # another process imports the same file
            else:
                yield part

    def tell(share: float) -> None:
        if progress is not None:
            progress(ImportProgress(mesh_file.link, n_done, n_parts, voxels, share))

    for obj, rows in _voxelized(still_missing(), mesh_file, store, options.unit, jobs, tell):
        n_done += 1
        if (new_id := added_or_present(store, obj, rows, known)) is not None:
            added.add(new_id)
        voxels += obj.voxels
        tell(0.0)
    n_dropped = drop_others(store, mesh_file) if options.replace else 0
    written = tuple(obj for obj in store.objects() if obj.id in added) if added else ()
    return FileReport(
        mesh_file.link,
        "imported" if added or n_replaced or n_dropped else "complete",
        written,
        n_parts - len(added) - n_kept - n_replaced,
        restored=sum(obj.name in removed for obj in written),
        kept_removed=n_kept,
        replaced=n_replaced,
        dropped=n_dropped,
        defects=mesh_file.defects,
        is_unit_assumed=options.unit is None and not mesh_file.names_unit,
    )


def _voxelized(
    parts: Iterable[Part],
    file: MeshFile,
    store: Store,
    unit: str | None,
    jobs: int,
    tell: ShareCallback = lambda _share: None,
) -> Iterator[tuple[Object, Rows]]:
    """Objects and rows of parts, in their order, a few parts ahead of the writer.

    tell: called in this thread with the share of the part that is waited for.
    """
    shares: dict[str, float] = {}
    attributes = {"unit": unit, "up": file.up}
    known = {name: value for name, value in attributes.items() if value}

    def work(part: Part) -> tuple[Object, Rows]:
        def done(share: float) -> None:
            shares[part.name] = share

        try:
            rows, n_voxels = rows_of_part(part, store.grid, store.layout, progress=done)
        except FileError as error:
            raise FileError(f"{file.link}: {error}") from None
        return (
            Object(
                name=part.name,
                link=file.link,
                digest=part.digest,
                transform=part.world_from_part,
                voxels=n_voxels,
                bounds=part.bounds,
                attributes=known,
            ),
            rows,
        )

    waiting: deque[tuple[str, Future[tuple[Object, Rows]]]] = deque()

    def finished() -> tuple[Object, Rows]:
        name, future = waiting.popleft()
        while not wait([future], EVERY).done:
            tell(shares.get(name, 0.0))
        return future.result()

    pool = ThreadPoolExecutor(jobs, thread_name_prefix="voxelize")
    try:
        for part in parts:
            waiting.append((part.name, pool.submit(work, part)))
            if len(waiting) > 2 * jobs:
                yield finished()
        while waiting:
            yield finished()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def check_placed_inside(
    part: Part, link: str, grid: Grid, world_from_part: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Bounds (2, 3) of a placed part in metres; refuses one that leaves the grid."""
    points = part.world_points(world_from_part)
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    scaled = grid.to_voxel_units(bounds)
    # a point on the upper border has no voxel; a surface there still touches the last one
    over = scaled[1] >= grid.side if part.is_cloud else scaled[1] > grid.side + AT_BORDER
    if not np.isfinite(bounds).all() or (scaled[0] < -AT_BORDER).any() or over.any():
        raise OutsideGridError(
            f"{link}: part {part.name!r} spans {_box(bounds)} m, outside the grid's "
            f"{_box(grid.bounds)} m; move it, or make an environment with a larger --extent"
        )
    return bounds


def _check_names(mesh_file: MeshFile) -> None:
    """Refuse names that not every engine can hold as text."""
    for name in (mesh_file.link, *(part.name for part in mesh_file.parts)):
        try:
            name.encode()
        except UnicodeEncodeError:
            is_text = False
        else:
            is_text = "\0" not in name
        if not is_text:
            raise FileError(f"{mesh_file.link!a}: the name {name!a} is no text: rename it")


def _check_inside(mesh_file: MeshFile, grid: Grid, parts: Sequence[Part] | None = None) -> None:
    for part in mesh_file.parts if parts is None else parts:
        check_placed_inside(part, mesh_file.link, grid)


def _box(bounds: NDArray[np.float64]) -> str:
    low, high = (", ".join(f"{x:.6g}" for x in corner) for corner in bounds)
    return f"({low}) to ({high})"


def _check_layout(store: Store, layout: Layout | None) -> None:
    if layout is not None and layout != store.layout:
        raise UsageError(
            f"{store.url} has the layout {store.layout}, not {layout}; leave --layout out"
        )


def _first_bounds(store: Store, mesh_file: MeshFile) -> NDArray[np.float64] | None:
    """Bounds that `--extent` was meant for: only the first file decided on the grid."""
    first = next(iter(store.objects()), None)
    if first is None or first.link == mesh_file.link:
        return mesh_file.bounds
    return None


@contextlib.contextmanager
def _closing_on_error(store: Store) -> Iterator[None]:
    try:
        yield
    except BaseException:
        store.close()
        raise
