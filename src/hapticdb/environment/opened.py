"""Class `Environment`: objects, edits and statistics of an opened database."""

import os
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.closing import Closes
from hapticdb.environment.queries import Queries
from hapticdb.errors import ReadOnlyError, UsageError
from hapticdb.grid import Grid
from hapticdb.ingest.files import FileReport, ImportCallback, ImportOptions, ingest_file
from hapticdb.ingest.geometry import shell_of_objects
from hapticdb.ingest.layout import voxels_of_rows
from hapticdb.ingest.object_moves import move_object, restore_object, shift_objects
from hapticdb.mesh import MeshFile, Part, read_file
from hapticdb.paper.cost_model import CostModel
from hapticdb.paper.figures import QueryFigures
from hapticdb.paper.quantiles import DEFAULT_RESOLUTION, QuantileVector
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.haptic_query import as_id
from hapticdb.store.base import Layout, Object, Size, Store
from hapticdb.store.covering import object_ranges
from hapticdb.store.filtering import Filter
from hapticdb.store.finding import Words, find_objects
from hapticdb.store.urls import scheme_of


class Environment(Queries, Closes):
    """An opened database with a static scene. Only the thread that opened it may use it.

    Use `hapticdb.open` and `hapticdb.create` to make one. It is also a context manager.
    """

    def __init__(self, store: Store, address: str | os.PathLike[str] | None = None) -> None:
        given = store.url if address is None else os.fspath(address)
        whole = given if scheme_of(given) else os.path.abspath(given)  # noqa: PTH100 - as text
        self._figures = QueryFigures(store)
        super().__init__(store, self._figures, whole)

    def __repr__(self) -> str:
        return f"Environment({self.url!r}, {self.layout} layout, {self.grid.describe()})"

    def close(self) -> None:
        """Close the connection to the database."""
        self._store.close()

    @property
    def url(self) -> str:
        """URL of the environment."""
        return self._store.url

    @property
    def name(self) -> str:
        """Name among the environments in the same database."""
        return self._store.name

    @property
    def engine(self) -> str:
        """Engine and version: ``SQLite 3.51.0``, ``PostgreSQL 18.6``."""
        return self._store.engine

    @property
    def grid(self) -> Grid:
        """Grid: converts between metres, voxels and keys."""
        return self._store.grid

    @property
    def layout(self) -> Layout:
        """Layout of the index table: ``voxel`` or ``brick``."""
        return self._store.layout

    @property
    def store(self) -> Store:
        """Store of the engine: for direct queries, such as benchmarks."""
        return self._store

    def size(self) -> Size:
        """Rows, bytes and leaf blocks of the database."""
        return self._store.size()

    # -- objects -----------------------------------------------------------------------------

    def objects(self) -> list[Object]:
        """All objects, ordered by id; reads only those written since the last call."""
        return self._query.known.newest()

    def object(self, object_id: int) -> Object:
        """One object; raises `ObjectNotFoundError` for an unknown id."""
        return self._store.object(as_id(object_id))

    def find(self, *words: int | str) -> list[Object]:
        """Objects selected by ids, names, patterns and attributes, each once, ordered by id.

        ``env.find(7, "wheel*", "body/door_*", "material=steel")``: rules and errors as of
        `hapticdb.store.finding.find_objects`.
        """
        return find_objects(self, words)

    def select(self, where: Words = (), exclude: Words = ()) -> list[Object]:
        """Objects selected by `where` and `exclude`, ordered by id; errors as for `touch`."""
        return Filter(where, exclude).select(self.objects(), self.url)

    def shell(
        self,
        *words: int | str,
        points: int | None = None,
        spacing: float | None = None,
        seed: int = 0,
        inset: float | None = None,
    ) -> PointShell:
        """Make one rigid tool from objects at their present poses.

        The shell is in the world frame, metres: its present pose is the identity, and the poses of
        a path are displacements. Exclude the objects from the force: ``exclude=words``. Arguments
        as for `find` and `tool`, for all surfaces together.

        Raises `ObjectNotFoundError` for a word without a match; `UsageError` for no word, or for a
        point cloud, which has no surface.
        """
        drawn = self._inset if inset is None else inset
        return shell_of_objects(self._store, self.find(*words), points, spacing, seed, drawn)

    def add(
        self,
        file: str | os.PathLike[str] | Part,
        *,
        unit: str | None = None,
        jobs: int | None = None,
        keep_removed: bool = False,
        replace: bool = False,
        chord: float | None = None,
        progress: ImportCallback | None = None,
    ) -> FileReport:
        """Import a file's parts on this environment's grid, each in a transaction of its own.

        file : mesh, CAD or point-cloud file; see `hapticdb.mesh.read_file`. Or a part, such as of
            `hapticdb.sweep_envelope`; its name is that of its file, too
        unit : unit of a file without one, of `hapticdb.mesh.UNITS`; metres unless given
        jobs : threads of voxelization; one for each processor unless given
        keep_removed : skip parts removed from the environment; otherwise they are added again
        replace : replace objects of changed parts, and remove objects without a part in the file
        chord : greatest chord error of a STEP or IFC file's tessellation, metres; unless given as
            for `hapticdb.mesh.read_file`
        progress : called after each part with a `hapticdb.ingest.files.ImportProgress`

        Raises `FileError` for an unusable file or a part outside the grid; then nothing is written.
        """
        self._check_writable()
        options = ImportOptions(
            unit=unit, jobs=jobs, layout=self.layout, keep_removed=keep_removed, replace=replace,
            chord=chord,
        )  # fmt: skip
        mesh_file = (
            MeshFile(file.name, [file], file.defects, names_unit=True)
            if isinstance(file, Part)
            else read_file(file, **options.reading)
        )
        with self._store.loading():
            report = ingest_file(self._store, mesh_file, options, progress)
        if report.status == "imported":
            self._store.analyze(DEFAULT_RESOLUTION)
            self._forget()
        return report

    def remove(self, object_id: int, *, revision: int | None = None) -> Object:
        """Remove an object in one transaction; returns it with its surface, for `restore`.

        Raises `ConflictError` if `revision` is given and the object has been written since.
        """
        self._check_writable()
        removed = self._store.remove(as_id(object_id), revision)
        self._forget()
        return removed

    def restore(self, removed: Object) -> Object:
        """Put back an object returned by `remove`, with its id, in one transaction.

        Raises `EnvironmentExistsError` if the part is in the environment; `UsageError` if neither
        `removed` nor the environment has its surface.
        """
        self._check_writable()
        object_id = restore_object(self._store, removed)
        self._forget()
        return self.object(object_id)

    def move(
        self, object_id: int | str, transform: ArrayLike, *, revision: int | None = None
    ) -> Object:
        """Move an object to a new pose, in one transaction.

        object_id : or a word of `find` that selects one object
        transform (4, 4) : world_from_part, metres; replaces the present transform, scale included.

        Raises `ConflictError` if `revision` is given and the object has been written since;
        `OutsideGridError` for a pose beyond the grid.
        """
        self._check_writable()
        if isinstance(object_id, str):
            found = self.find(object_id)
            if len(found) > 1:
                raise UsageError(f"move: {object_id!r} selects {len(found)} objects: give one")
            object_id = found[0].id
        elif isinstance(object_id, Iterable):
            raise UsageError(f"move: {object_id!r}: give one id, or a word that selects one object")
        move_object(self._store, self.object(object_id), transform, revision)
        self._forget()
        return self.object(object_id)

    def shift(self, object_ids: Iterable[int], translation: ArrayLike) -> list[Object]:
        """Shift objects by `translation` (3,), metres, world frame: all of them, or none.

        One transaction: other writers wait meanwhile; readers do not. Raises `OutsideGridError` as
        for `move`.
        """
        self._check_writable()
        shifted = shift_objects(self._store, object_ids, translation)
        self._forget()
        return shifted

    def voxels(self, object_id: int) -> NDArray[np.int64]:
        """Voxels (n, 3) touched by an object's surface, in order of their keys."""
        with self._store.snapshot():
            obj = self.object(object_id)
            rows = self._store.rows_of(obj.id, *object_ranges(self.grid, self.layout, obj))
        return voxels_of_rows(rows, self.grid, self.layout)

    # -- statistics --------------------------------------------------------------------------

    def quantiles(self, resolution: int = DEFAULT_RESOLUTION) -> QuantileVector:
        """Quantile vector of the index's keys (the paper's Definition 2)."""
        return QuantileVector.of(self._store, resolution)

    def analyze(self) -> QuantileVector:
        """Renew the statistics of the strategy ``cbgroup``, even if they are up to date."""
        self._check_writable()
        return self._figures.analyze()

    def calibrate(self, *, keep: bool = True, cold: bool = False) -> CostModel:
        """Measure the cost of queries on this database, for use and, if `keep`, to be stored.

        cold : with empty caches, for environments larger than memory.
        """
        return self._figures.calibrate(keep=keep, cold=cold)

    def _forget(self) -> None:
        """Drop the values cached before an edit of this environment."""
        self._figures.rows_changed()
        self._query.known.invalidate()

    def _check_writable(self) -> None:
        if self._store.is_read_only:
            raise ReadOnlyError(f"{self.url} was opened to read: open it without read_only")
