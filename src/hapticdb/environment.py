"""Environment: an opened database."""

import os
from collections.abc import Iterable
from time import perf_counter_ns
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import ConnectionLostError, ReadOnlyError
from hapticdb.grid import Grid
from hapticdb.ingest.files import FileReport, ImportCallback, ImportOptions, ingest_file
from hapticdb.ingest.layout import voxels_of_rows
from hapticdb.ingest.moving import move_object, shift_objects
from hapticdb.ingest.originals import shell_of_objects
from hapticdb.mesh import read_file
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.cost_model import CostModel
from hapticdb.query.figures import QueryFigures
from hapticdb.query.frame import (
    NOTHING_EXCLUDED,
    Answer,
    HapticQuery,
    Strategy,
    as_id,
    as_ids,
    as_poses,
)
from hapticdb.query.grouping import DEFAULT_MAXGAP, Ranges, object_ranges
from hapticdb.query.known_objects import KnownObjects
from hapticdb.query.law import ForceLaw, TangentPlane
from hapticdb.query.quantiles import DEFAULT_RESOLUTION, QuantileVector
from hapticdb.query.touches import Touch, Touches
from hapticdb.store.base import Freshness, Keys, Layout, Object, Size, Store
from hapticdb.store.connect import create_store, open_store
from hapticdb.store.finding import find_objects

_NOBODY: tuple[int, ...] = ()


class Environment:
    """A static scene in one database, opened. Belongs to the thread that opened it.

    Use `hapticdb.open` and `hapticdb.create`; also as a context manager, which closes it.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._figures = QueryFigures(store)
        self._query = HapticQuery(store, self._figures.both)
        self._known = KnownObjects(store)

    def __repr__(self) -> str:
        return f"Environment({self.url!r}, {self.layout} layout, {self.grid.describe()})"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection to the database."""
        self._store.close()

    @property
    def url(self) -> str:
        """Where the environment is."""
        return self._store.url

    @property
    def name(self) -> str:
        """Its name among the environments at the same place."""
        return self._store.name

    @property
    def engine(self) -> str:
        """Engine and version: ``SQLite 3.51.0``, ``PostgreSQL 18.6``."""
        return self._store.engine

    @property
    def grid(self) -> Grid:
        """Converts between metres, voxels and keys."""
        return self._store.grid

    @property
    def layout(self) -> Layout:
        """``voxel`` or ``brick``: which index table it has."""
        return self._store.layout

    @property
    def store(self) -> Store:
        """The engine below: for tools that ask it directly, such as benchmarks."""
        return self._store

    def size(self) -> Size:
        """Rows, bytes and leaf blocks of the database."""
        return self._store.size()

    # -- objects -----------------------------------------------------------------------------

    def objects(self) -> list[Object]:
        """All objects, ordered by id."""
        return self._store.objects()

    def object(self, object_id: int) -> Object:
        """One object.

        Raises
        ------
        ObjectNotFoundError
            When there is none of that id.
        """
        return self._store.object(as_id(object_id))

    def find(self, *words: int | str) -> list[Object]:
        """Objects that ids, names and patterns choose, each once, ordered by id.

        ``env.find(7, "wheel*", "body/door_*")``: the rules, and the errors, are those of
        `hapticdb.store.finding.find_objects`. A sub-assembly's name chooses all that is below it.
        """
        return find_objects(self._store, words)

    def shell(
        self,
        *words: int | str,
        points: int | None = None,
        spacing: float | None = None,
        seed: int = 0,
    ) -> PointShell:
        """Make objects one rigid tool, where they sit: their surfaces, read from their files again.

        The shell is in the world's frame, metres, so that its own pose is the identity, and the
        poses of a path are displacements. Leave the objects out of what is felt:
        ``exclude=[obj.id for obj in env.find(*words)]``.

        Parameters
        ----------
        words : int or str
            As for `find`.
        points, spacing, seed
            As for `PointShell.from_file`, spread over all surfaces together.

        Raises
        ------
        ObjectNotFoundError
            When a word chooses nothing.
        GeometryChangedError
            When an object's file is gone or holds another geometry.
        UsageError
            When no word is given, or an object is a point cloud, which has no surface.
        """
        return shell_of_objects(self.find(*words), points, spacing, seed)

    def add(
        self,
        file: str | os.PathLike[str],
        *,
        unit: str | None = None,
        jobs: int | None = None,
        keep_removed: bool = False,
        replace: bool = False,
        progress: ImportCallback | None = None,
    ) -> FileReport:
        """Import a file's parts on this environment's grid, each in a transaction of its own.

        Parameters
        ----------
        file : path
            Mesh, CAD or point-cloud file; see `hapticdb.mesh.read_file`.
        unit : str or None
            One of `hapticdb.mesh.UNITS`, of a file that carries none; metres unless given.
        jobs : int or None
            Threads that voxelize; one a processor unless given.
        keep_removed : bool
            Leave parts out that were removed; they come in again otherwise.
        replace : bool
            Replace objects of the file that it holds otherwise now, and remove those it lacks.
        progress : callable or None
            Called after each part with a `hapticdb.ingest.files.ImportProgress`.

        Raises
        ------
        FileError
            When the file cannot be used, or a part lies outside the grid: nothing is written then.
        """
        self._check_writable()
        options = ImportOptions(
            unit=unit, jobs=jobs, layout=self.layout, keep_removed=keep_removed, replace=replace
        )
        mesh_file = read_file(file, unit=unit)
        with self._store.loading():
            report = ingest_file(self._store, mesh_file, options, progress)
        if report.status == "imported":
            self._store.analyze(DEFAULT_RESOLUTION)
            self._forget()
        return report

    def remove(self, object_id: int) -> None:
        """Remove an object and its rows, in one transaction."""
        self._check_writable()
        self._store.remove(as_id(object_id), self._covering)
        self._forget()

    def move(self, object_id: int, transform: ArrayLike, *, revision: int | None = None) -> Object:
        """Place an object anew, in one transaction; its geometry is read from its file again.

        Parameters
        ----------
        object_id : int
            Which object.
        transform : (4, 4) array
            world_from_part, metres; replaces the present one, scale and all.
        revision : int or None
            Of the object that the placement was derived from, as `Object.revision` gave it.

        Raises
        ------
        ConflictError
            When `revision` is given and another has written the object since.
        GeometryChangedError
            When the object's file is gone or holds another geometry.
        OutsideGridError
            When it would leave the grid.
        """
        self._check_writable()
        old = self.object(object_id)
        move_object(self._store, old, transform, revision, self._covering)
        self._forget()
        return self.object(object_id)

    def shift(self, object_ids: Iterable[int], way: ArrayLike) -> list[Object]:
        """Shift objects alike from where each is, in a transaction each; files are read once.

        Parameters
        ----------
        object_ids : iterable of int
            Which objects; `find` chooses them by name.
        way : (3,) array
            Metres, world frame. Where another moves an object meanwhile, it counts from there.

        Raises
        ------
        GeometryChangedError, OutsideGridError
            As for `move`; then none is shifted.
        """
        self._check_writable()
        shifted = shift_objects(self._store, object_ids, way, self._covering)
        self._forget()
        return shifted

    def voxels(self, object_id: int) -> NDArray[np.int64]:
        """Voxels (n, 3) that an object's surface touches, in the order of their keys."""
        with self._store.snapshot():
            obj = self.object(object_id)
            rows = self._store.rows_of(obj.id, *self._ranges_of(obj))
        return voxels_of_rows(rows, self.grid, self.layout)

    # -- the haptic query --------------------------------------------------------------------

    def touch(
        self,
        shell: PointShell,
        pose: ArrayLike,
        strategy: Strategy = "auto",
        *,
        exclude: Iterable[int] = _NOBODY,
        maxgap: int = DEFAULT_MAXGAP,
        law: ForceLaw | None = None,
    ) -> Touch:
        """Force and torque that the environment exerts on the tool at one pose.

        Parameters
        ----------
        shell : PointShell
            Points in metres and inward unit normals, tool frame.
        pose : (4, 4) array
            world_from_tool, rigid, metres.
        strategy : str
            How the database is asked: ``statement``, ``array``, ``points``, ``maxgap``,
            ``cbgroup``, or ``auto``: ``cbgroup`` where a frame has many keys and few ranges hold
            them, else ``array``. All find the same hits, ids and wrench, bit for bit.
        exclude : iterable of int
            Ids of objects that are not felt: a part taken out must not hit itself.
        maxgap : int
            Of the strategy ``maxgap``: neighbours at most so many voxel keys apart share a range.
        law : TangentPlane or None
            The force law; 1000 N/m unless given.

        Raises
        ------
        UsageError
            When the pose is not rigid or the strategy unknown.
        ObjectNotFoundError
            When an excluded object does not exist.

        Notes
        -----
        Points outside the grid miss. All statements of a touch read one committed revision.
        """
        ids = NOTHING_EXCLUDED if exclude is _NOBODY else as_ids(exclude)
        force_law = law or _DEFAULT_LAW
        try:
            answer = self._felt(shell, pose, strategy, maxgap, ids, force_law)
        except ConnectionLostError:  # in the middle of a snapshot: once more, from its start
            answer = self._felt(shell, pose, strategy, maxgap, ids, force_law)
        if ids.size:
            self._known.check_excluded(ids)
        self._known.check_answer(answer.ids)
        return Touch(answer, self._known.by_id)

    def _felt(
        self,
        shell: PointShell,
        pose: ArrayLike,
        strategy: Strategy,
        maxgap: int,
        ids: Keys,
        law: ForceLaw,
    ) -> Answer:
        """Answer of a frame; afterwards the objects of the revision that it saw are known."""
        answer = self._query.run(shell, pose, strategy, maxgap, ids, law)
        if self._store.version() != self._known.version:
            with self._store.snapshot():
                answer = self._query.run(shell, pose, strategy, maxgap, ids, law)
                self._learn_objects()
        return answer

    def _learn_objects(self) -> None:
        """Know the objects of the revision that this snapshot sees."""
        if self._known.learn():
            self._figures.drop_empty_statistics()

    def touch_many(
        self,
        shell: PointShell,
        poses: ArrayLike,
        strategy: Strategy = "auto",
        *,
        exclude: Iterable[int] = _NOBODY,
        maxgap: int = DEFAULT_MAXGAP,
        law: ForceLaw | None = None,
        contacts: bool = False,
    ) -> Touches:
        """Force and torque at many poses, as `touch` gives them one by one, bit for bit.

        Parameters
        ----------
        poses : (n, 4, 4) array
            Each a world_from_tool, rigid, metres.
        strategy : str
            ``auto`` asks for the rows of neighbouring poses in one statement; any other asks pose
            by pose, as `touch` does.
        contacts : bool
            Whether to list every contact, too.
        shell, exclude, maxgap, law
            As for `touch`.

        Raises
        ------
        UsageError, ObjectNotFoundError
            As for `touch`; nothing is returned then.
        """
        ids = NOTHING_EXCLUDED if exclude is _NOBODY else as_ids(exclude)
        where, started = as_poses(poses), perf_counter_ns()

        def felt() -> Touches:
            answers = self._query.run_many(shell, where, strategy, maxgap, ids, law or _DEFAULT_LAW)
            with self._store.snapshot():
                touches = Touches(len(where), has_contacts=contacts).gather(answers)
                self._learn_objects()
            return touches

        if strategy == "cbgroup":
            self._figures.both()  # measured outside the snapshot
        try:
            touches = felt()
        except ConnectionLostError:  # once more, from its start
            touches = felt()
        if ids.size:
            self._known.check_excluded(ids)
        return touches.name(self._known.by_id, (perf_counter_ns() - started) / 1000)

    # -- statistics --------------------------------------------------------------------------

    def quantiles(self, resolution: int = DEFAULT_RESOLUTION) -> QuantileVector:
        """Quantile vector of the index's keys (the paper's Definition 2)."""
        return QuantileVector.of(self._store, resolution)

    def freshness(self) -> Freshness:
        """How old the statistics are that grouping by cost uses."""
        return self._store.freshness(DEFAULT_RESOLUTION)

    def analyze(self) -> QuantileVector:
        """Renew the statistics that grouping by cost uses, however fresh they are."""
        self._check_writable()
        return self._figures.analyze()

    def calibrate(self, *, seed: int = 0, keep: bool = True, cold: bool = False) -> CostModel:
        """Measure what queries cost here; the figures are used from now on, and kept.

        Parameters
        ----------
        seed : int
            Of the random choice of the places that are measured.
        keep : bool
            Write the figures into the database, when it can be written.
        cold : bool
            Measure with empty caches, where this process can empty them: for environments that
            are larger than memory.
        """
        return self._figures.calibrate(seed=seed, keep=keep, cold=cold)

    def _forget(self) -> None:
        """Forget what an edit of this environment has made stale."""
        self._figures.drop_statistics()
        self._known.forget()

    def _check_writable(self) -> None:
        if self._store.is_read_only:
            raise ReadOnlyError(f"{self.url} was opened to read: open it without read_only")

    def _covering(self, obj: Object) -> Iterable[tuple[int, int]]:
        lows, highs = self._ranges_of(obj)
        return zip(lows.tolist(), highs.tolist(), strict=True)

    def _ranges_of(self, obj: Object) -> Ranges:
        return object_ranges(self.grid, self.layout, obj.bounds)


_DEFAULT_LAW = TangentPlane()


def open(url: str | os.PathLike[str], *, read_only: bool = False) -> Environment:  # noqa: A001 - the word users expect, as in tarfile.open
    """Open an environment.

    Parameters
    ----------
    url : str or path
        A path, ``sqlite:///path``, or ``postgresql://user@host/database?environment=NAME``.
    read_only : bool
        Refuse every write; works on files and folders that cannot be written.

    Raises
    ------
    EnvironmentNotFoundError, NotAnEnvironmentError, NewerVersionError, DamagedError
        When there is none, or something else, or one that cannot be read.
    """
    return Environment(open_store(url, read_only=read_only))


def create(url: str | os.PathLike[str], grid: Grid, *, layout: Layout = "brick") -> Environment:
    """Make an environment with that grid and open it.

    Raises
    ------
    EnvironmentExistsError
        When something is there already.
    UsageError
        When bricks are asked for in lexicographic order.
    """
    return Environment(create_store(url, grid, layout))
