"""Import of files as objects, rows and surfaces: a transaction for each object, in file order.

Objects are written in the order of the files and of their parts, for any number of jobs. So a rerun
of an interrupted import ends with the same rows and ids as an undisturbed one.
"""

import contextlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.cluster.scheduler import Cluster, connected
from hapticdb.errors import (
    EnvironmentExistsError,
    FileError,
    HapticDBError,
    MissingExtraError,
    ObjectNotFoundError,
    UsageError,
)
from hapticdb.grid import Grid, GridOptions
from hapticdb.ingest.planning import (
    Plan,
    StoredParts,
    added_or_present,
    check_inside,
    check_names,
    planned,
)
from hapticdb.ingest.voxelizing import voxelize_parts
from hapticdb.mesh import Defects, MeshFile, read_file
from hapticdb.mesh.chord import check_chord
from hapticdb.paper.quantiles import DEFAULT_RESOLUTION
from hapticdb.store.base import Layout, Object, Store
from hapticdb.store.connect import check_curve, create_store, exists, open_store
from hapticdb.store.store_errors import wants_distances


class ImportProgress(NamedTuple):
    """Progress of an import: after each part, and five times a second with its `share`, 0 to 1."""

    link: str
    parts_done: int
    parts_total: int
    voxels: int
    share: float = 0.0


ImportCallback = Callable[[ImportProgress], None]


@dataclass(frozen=True)
class FileReport:
    """Result of the import of one file."""

    link: str
    status: Literal["imported", "complete", "failed"]
    """Objects were written; all objects were present already; the file was skipped, see `error`."""
    added: tuple[Object, ...] = ()
    """Newly written objects, in the file's order."""
    present: int = 0
    """Number of objects already in the environment."""
    restored: int = 0
    """Number of added parts that had been removed from the environment before."""
    still_removed: int = 0
    """Number of removed parts that were skipped: `ImportOptions.keep_removed`."""
    replaced: int = 0
    dropped: int = 0
    """Numbers of objects replaced and removed: `ImportOptions.replace`."""
    defects: Defects = field(default_factory=Defects)
    notes: tuple[str, ...] = ()
    """Content of the file that was not read, or read otherwise than meant."""
    error: HapticDBError | None = None
    chord: float = 0.0
    """Greatest chord error of the placed parts, metres, world frame; 0.0 for exact triangles."""
    is_unit_assumed: bool = False
    """Whether metres were assumed, because neither the file nor the options give a unit."""

    def __repr__(self) -> str:
        what = f"objects added: {len(self.added)}, there before: {self.present}"
        return f"FileReport({self.link}: {self.status}, {self.error or what})"


MOST_AHEAD = 1 << 29
"""Most bytes of geometry in memory of files read ahead. Less: more files are read twice."""
_READING = ("unit", "time_limit", "memory_limit", "chord")


@dataclass(frozen=True)
class ImportOptions:
    """Options of reading and voxelizing files."""

    unit: str | None = None
    """Unit of files without one, one of `hapticdb.mesh.UNITS`; metres unless given."""
    grid: GridOptions = field(default_factory=GridOptions)
    """Grid of a new environment; must agree with an existing one, as layout and distances must."""
    layout: Layout | None = None
    """Bricks unless given."""
    jobs: int | None = None
    """Voxelizer threads; one for each processor unless given."""
    on: str | None = None
    """Scheduler of dask.distributed, ``tcp://host:8786``; its workers voxelize instead."""
    keep_removed: bool = False
    """Skip parts removed from the environment before; otherwise they are added again."""
    time_limit: float | None = None
    memory_limit: int | None = None
    """Greatest time (s) and memory (bytes) for reading one file, see `hapticdb.mesh.read_file`."""
    voxel_limit: float | None = None
    """Most voxels met by the surfaces of one file, estimated by their area; see
    `hapticdb.ingest.planning.check_cost`."""
    chord: float | None = None
    """Greatest chord error of the tessellations of STEP and IFC files, metres; unless given as for
    `hapticdb.mesh.read_file`. The resulting ones are stored with the surfaces, see `Part.chord`."""
    replace: bool = False
    """Also replace objects, under their ids, after a change of geometry, placement, attributes or
    unit, and remove those of parts missing in the file."""
    skip_unusable: bool = False
    """Import the other files if one is unusable; its report has the error."""
    distances: bool | None = None
    """Whether parts of a new environment get distances to their surfaces, needed by the force law.
    By default they do in the layout brick. The layout voxel has none."""

    def __post_init__(self) -> None:
        limits = {
            "seconds": self.time_limit, "bytes": self.memory_limit, "voxels": self.voxel_limit
        }  # fmt: skip
        for name, limit in limits.items():
            if limit is not None and not 0 < limit < np.inf:
                raise UsageError(f"a limit of {limit} {name}: give a number above 0")
        check_chord(self.chord)
        if self.jobs is not None and self.jobs < 1:
            raise UsageError(f"{self.jobs} jobs: give 1 or more")
        if self.jobs is not None and self.on is not None:
            raise UsageError(f"{self.jobs} jobs on {self.on}: workers have threads of their own")
        if self.layout is not None and self.grid.curve is not None:
            check_curve(self.grid.curve, self.layout)

    @property
    def reading(self) -> dict[str, Any]:
        """Given options of `read_file`, by name."""
        return {name: getattr(self, name) for name in _READING if getattr(self, name) is not None}


def import_files(
    url: str | os.PathLike[str],
    files: Sequence[str | os.PathLike[str]],
    options: ImportOptions | None = None,
    progress: ImportCallback | None = None,
) -> list[FileReport]:
    """Import files into an environment, created if it does not exist.

    The grid of a new environment contains all of them; one without any object is removed again.

    Returns a report for each file, in order.

    Raises `FileError` or `MissingExtraError` at the first unusable file, unless
    `ImportOptions.skip_unusable`: the files before it stay imported. Raises `GridError` or
    `UsageError` if the options are invalid, or contradict an existing environment; `DatabaseError`
    if the environment cannot be opened or written.
    """
    chosen = options or ImportOptions()
    if isinstance(files, (str, bytes, os.PathLike)):
        raise UsageError(f"files {files!r}: give a list of files")
    if not files:
        raise UsageError("no files: name at least one to import")
    with connected(chosen.on) as workers, contextlib.closing(_Target(url, chosen)) as target:
        sources = _Sources(files, chosen.reading)
        with target.loading:
            reports = [
                _import_file(target, sources, n, chosen, progress, workers)
                for n in range(len(files))
            ]
        if target.store is not None and target.store.revision():
            target.store.analyze(DEFAULT_RESOLUTION)
    return reports


class _Sources:
    """Files of an import; those read ahead, for their bounds, stay up to `MOST_AHEAD` bytes."""

    def __init__(self, files: Sequence[str | os.PathLike[str]], reading: dict[str, Any]) -> None:
        self.files, self._reading = files, reading
        self._ahead: dict[int, MeshFile | FileError | MissingExtraError] = {}
        self._bytes = 0

    def read(self, n: int) -> MeshFile:
        """Read file n; FileError, MissingExtraError."""
        found = self._ahead.pop(n, None)
        if found is None:
            return read_file(self.files[n], **self._reading)
        if isinstance(found, MeshFile):
            self._bytes -= _bytes_of(found)
            return found
        raise found

    def bounds_from(self, n: int, first: MeshFile) -> NDArray[np.float64]:
        """AABB (2, 3) of file n, already read, and of all usable files after it."""
        boxes = [first.bounds]
        for later in range(n + 1, len(self.files)):
            try:
                found = self.read(later)
            except (FileError, MissingExtraError) as error:
                self._ahead[later] = error
                continue
            boxes.append(found.bounds)
            if self._bytes + _bytes_of(found) <= MOST_AHEAD:
                self._ahead[later] = found
                self._bytes += _bytes_of(found)
        low, high = np.stack(boxes, axis=1)
        return np.stack([low.min(axis=0), high.max(axis=0)])


def _bytes_of(mesh_file: MeshFile) -> int:
    return sum(
        part.vertices.nbytes + (0 if part.faces is None else part.faces.nbytes)
        for part in mesh_file.parts
    )


def _import_file(
    target: "_Target",
    sources: _Sources,
    n: int,
    options: ImportOptions,
    progress: ImportCallback | None,
    workers: Cluster | None,
) -> FileReport:
    """Import file n; the report of an unusable one has the error."""
    try:
        mesh_file = sources.read(n)
        store = target.store_for(mesh_file, lambda: sources.bounds_from(n, mesh_file))
        return ingest_file(store, mesh_file, options, progress, workers)
    except (FileError, MissingExtraError) as error:
        if not options.skip_unusable:
            raise
        return FileReport(os.fspath(sources.files[n]), "failed", error=error)


class _Target:
    """The environment of an import: opened, or created with a grid for all usable files."""

    def __init__(self, url: str | os.PathLike[str], options: ImportOptions) -> None:
        self._url, self._options = url, options
        self._layout: Layout = options.layout or "brick"
        self._is_new = self._is_loading = False
        self.loading = contextlib.ExitStack()
        """Keeps `Store.loading` active from the first usable file on."""
        self._is_checked = False
        self.store: Store | None = None
        if exists(url):
            self._join(options.layout, options.grid)
        else:
            check_curve(options.grid.curve or "z", self._layout)
            wants_distances(self._layout, options.distances)

    def close(self) -> None:
        """Close the store; discard an environment created here without a write."""
        if self.store is None:
            return
        if self._is_new and not self.store.revision():
            self.store.discard()
        else:
            self.store.close()

    def store_for(self, mesh_file: MeshFile, bounds: Callable[[], NDArray[np.float64]]) -> Store:
        """Return the store, ready to load a file; bounds : (2, 3) of this file and the later ones.

        The first usable file creates the environment.
        """
        grid_options = self._options.grid
        if self.store is None:
            grid = grid_options.fit(bounds())
            check_inside(mesh_file.parts, mesh_file.link, grid)
            self._create_or_join(grid)
        elif grid_options.extent is not None and not (self._is_new or self._is_checked):
            first = next(iter(self.store.objects()), None)  # --extent is meant for its command
            if first is None or first.link == mesh_file.link:
                grid_options.check_matches(self.store.grid, bounds())
        self._is_checked = True
        assert self.store is not None  # noqa: S101 - opened or made above
        if not self._is_loading:
            self.loading.enter_context(self.store.loading())
            self._is_loading = True
        return self.store

    def _create_or_join(self, grid: Grid) -> None:
        """Create the environment, or open it if another process has created it meanwhile."""
        try:
            wish = self._options.distances
            self.store = create_store(self._url, grid, self._layout, distances=wish)
            self._is_new = True
        except EnvironmentExistsError:
            same = GridOptions(grid.bits, grid.voxel_size, None, grid.origin, grid.curve)
            self._join(self._layout, same)

    def _join(self, layout: Layout | None, grid: GridOptions) -> None:
        """Open the environment; refuse options that contradict it."""
        store = open_store(self._url)
        try:
            _check_options(store, layout, self._options.distances)
            grid.check_matches(store.grid)
        except BaseException:
            store.close()
            raise
        self.store = store


def ingest_file(
    store: Store,
    mesh_file: MeshFile,
    options: ImportOptions,
    progress: ImportCallback | None = None,
    workers: Cluster | None = None,
) -> FileReport:
    """Write the parts of a file that the environment lacks.

    Raises `OutsideGridError` if a part leaves the grid; then nothing is written. Raises
    `GeometryChangedError` for a changed part without `ImportOptions.replace`.
    """
    check_names(mesh_file)
    known = StoredParts(store, mesh_file.link)
    plan = planned(
        mesh_file, options.unit, store.grid, known.by_name, store.removed(mesh_file.link),
        replace=options.replace, keep_removed=options.keep_removed,
        voxel_limit=options.voxel_limit,
    )  # fmt: skip
    jobs = workers or options.jobs or os.cpu_count() or 1
    added, n_replaced = _write_parts(store, mesh_file, plan, known, (options.unit, jobs), progress)
    n_dropped = 0
    for object_id in plan.dropped:
        with contextlib.suppress(ObjectNotFoundError):  # another process has removed it
            store.remove(object_id)
            n_dropped += 1
    written = tuple(store.objects(added)) if added else ()
    n_kept = len(plan.removed) if options.keep_removed else 0
    return FileReport(
        mesh_file.link,
        "imported" if added or n_replaced or n_dropped else "complete",
        written,
        len(mesh_file.parts) - len(added) - n_kept - n_replaced,
        restored=sum(obj.name in plan.removed for obj in written),
        still_removed=n_kept,
        replaced=n_replaced,
        dropped=n_dropped,
        defects=mesh_file.defects,
        notes=mesh_file.notes,
        chord=max(part.placed_chord for part in mesh_file.parts),
        is_unit_assumed=options.unit is None and not mesh_file.names_unit,
    )


def _write_parts(
    store: Store,
    mesh_file: MeshFile,
    plan: Plan,
    known: StoredParts,
    unit_and_jobs: tuple[str | None, int | Cluster],
    progress: ImportCallback | None,
) -> tuple[list[int], int]:
    """Write the parts of a plan, each in a transaction; ids of those added, number of replaced."""
    id_of = {part.name: object_id for part, object_id in plan.replaced}
    todo = [*(part for part, _ in plan.replaced), *plan.added]
    n_parts = len(mesh_file.parts)
    n_done = n_parts - len(todo)
    places = {part.name: n for n, part in enumerate(todo, start=n_done + 1)}
    # skip parts that another process has added meanwhile, before they are voxelized
    parts = (part for part in todo if part.name in id_of or not known.has(part))
    added: list[int] = []
    n_replaced = voxels = 0
    with contextlib.closing(voxelize_parts(parts, mesh_file, store, *unit_and_jobs)) as made:
        for one in made:
            if not isinstance(one, float):
                obj, rows, surface = one
                if obj.name not in id_of:
                    added += added_or_present(store, obj, rows, surface, known)
                else:
                    new = replace(obj, id=id_of[obj.name])
                    with contextlib.suppress(ObjectNotFoundError):  # another has removed it
                        store.replace(new, rows, surface)
                        n_replaced += 1
                n_done, voxels = places[obj.name], voxels + obj.voxels
            if progress is not None:
                share = one if isinstance(one, float) else 0.0
                progress(ImportProgress(mesh_file.link, n_done, n_parts, voxels, share))
    return added, n_replaced


def _check_options(store: Store, layout: Layout | None, distances: bool | None) -> None:  # noqa: FBT001 - an option as given
    """Refuse a layout or distances other than the environment's."""
    if layout is not None and layout != store.layout:
        raise UsageError(
            f"{store.url} has the layout {store.layout}, not {layout}; leave --layout out"
        )
    if distances is None or distances == store.wants_distances:
        return
    if distances:
        raise UsageError(f"{store.url} was made without distances: leave --distances out")
    raise UsageError(f"{store.url} was made with distances: leave --no-distances out")
