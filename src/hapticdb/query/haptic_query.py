"""The haptic query: plan, fetch, refine (the paper, section 4.2)."""

import math
import operator
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import ConnectionLostError, ObjectNotFoundError, UsageError
from hapticdb.kernels import force_law as laws
from hapticdb.kernels.field import lattice, packing
from hapticdb.kernels.query import brick_frames as brick_kernels
from hapticdb.kernels.query import refining, shell_keys
from hapticdb.poses import as_floats
from hapticdb.query.brick_cache import BrickCache, LocatedRows
from hapticdb.query.law import PLANE, ForceLaw
from hapticdb.query.object_cache import ObjectCache
from hapticdb.query.touches import Query, Touch
from hapticdb.store.base import Keys, Rows, Store, row_shift
from hapticdb.store.covering import Ranges
from hapticdb.store.filtering import ALL, Filter
from hapticdb.store.parsing import damaged

if TYPE_CHECKING:
    from hapticdb.pointshell.shell import PointShell

MOST_POINTS = 1 << 17
"""Shell points of one statement, summed over its poses, at most: 12 MB."""
LEAST_GROUPED = 1024
"""Distinct keys of a frame from which `auto` groups, on engines without a number of their own.

Measured on SQLite: beyond it a lookup is up to 1.1 times slower than ranges."""
KEYS_PER_RANGE = 2
"""Mean keys of a range from which `auto` scans ranges: one costs more than a key's lookup."""
NOTHING_EXCLUDED = np.empty(0, dtype=np.int64)

QueryCounts = tuple[str, int, int, int]
"""Fields of `Query` without the time, which is measured at the end of a frame."""
NO_QUERY: QueryCounts = ("array", 0, 0, 0)
Source = Callable[[bool], LocatedRows]
"""Returns the rows of a frame, with distances if they are read."""
Group = Callable[[Keys, bool], Ranges]
"""Groups the row keys (U,) of a frame into ranges; the flag: whether distances are read, too."""


class Form(Protocol):
    """Another form of a frame's query: a strategy of `hapticdb.paper.strategies`."""

    def touch(
        self, located: "shell_keys.Located", exclude: Keys, law: ForceLaw, started: int
    ) -> Touch:
        """Touch of a located shell; started : begin of the frame, ns."""


class HapticQuery:
    """Runs frames against one store.

    group : groups frames of many keys by cost; without it, all keys are looked up. known : objects
    of the last frame's revision; grid : the environment's. Bricks stay decoded in memory.
    """

    def __init__(self, store: Store, group: Group | None = None) -> None:
        self.store = store
        self._group = group
        self.known = ObjectCache(store)
        least = getattr(store, "grouping_threshold", LEAST_GROUPED)
        self._least_grouped = math.inf if least is None else least
        self._has_bricks = store.layout == "brick"
        self._memory: BrickCache | None = None
        self.grid = store.grid.for_kernels(row_shift(store.layout))

    def touch(
        self,
        shell: "PointShell",
        pose: ArrayLike,
        selection: Filter = ALL,
        law: ForceLaw | None = None,
        form: Form | None = None,
    ) -> Touch:
        """Touch of a shell at one pose; see `hapticdb.environment.Environment.touch`."""
        known, arguments = self.known, (shell, pose, form)
        try:
            touch = None
            if known.version is not None and (law is None or known.fits(law)):
                exclude = NOTHING_EXCLUDED if selection is ALL else known.excluded(selection)
                touch = self._frame(*arguments, exclude, law or known.own_law)
            if touch is None or not self._is_newest(touch, form):
                touch = self._touch_anew(*arguments, selection, law)
        except ConnectionLostError:
            touch = self._touch_anew(*arguments, selection, law)
        for stray in set(touch.ids).difference(known.by_id):
            raise damaged(self.store.url, f"rows of object {stray}, which is not there")
        if not selection.is_empty:
            known.check_words(selection)
        return touch

    def _is_newest(self, touch: Touch, form: Form | None) -> bool:
        """Whether no commit came between the listing of the cached objects and this frame's reads.

        A frame over bricks has compared versions after each statement; without one it does so now.
        """
        if form is not None or not self._has_bricks:
            return self.store.version() == self.known.version
        return touch.query.statements > 0 or self.store.newest() == self.known.version

    def _touch_anew(
        self,
        shell: "PointShell",
        pose: ArrayLike,
        form: Form | None,
        selection: Filter,
        law: ForceLaw | None,
    ) -> Touch:
        """Touch in a snapshot, after a refresh of its objects."""
        known = self.known
        with self.store.snapshot():
            chosen = known.law_of_newest(law)
            touch = self._frame(shell, pose, form, known.excluded(selection), chosen)
        assert touch is not None  # noqa: S101 - a snapshot is of one revision
        return touch

    def law_now(self, law: ForceLaw | None) -> ForceLaw:
        """Force law of a frame at the newest revision; refreshes the objects."""
        try:
            with self.store.snapshot():
                return self.known.law_of_newest(law)
        except ConnectionLostError:  # a lost snapshot is repeated, once
            with self.store.snapshot():
                return self.known.law_of_newest(law)

    def _frame(
        self, shell: "PointShell", pose: ArrayLike, form: Form | None, exclude: Keys, law: ForceLaw
    ) -> Touch | None:
        """Touch with the cached objects.

        None if bricks were read for it at another revision than theirs.
        """
        reads = laws.reads_distances(law.for_kernels)
        started = time.perf_counter_ns()
        if form is None and self._has_bricks:
            return self._over_bricks(shell, as_pose(pose), exclude, law, reads, started)
        located = locate(shell, as_pose(pose), self.grid)
        if form is not None:
            return form.touch(located, exclude, law, started)
        rows, counts = self._fetched(located.keys, reads)
        return self._over_rows(located, rows, counts, exclude, law, started)

    def _over_bricks(
        self,
        shell: "PointShell",
        pose: NDArray[np.float64],
        exclude: Keys,
        law: ForceLaw,
        reads: bool,  # noqa: FBT001 - private
        started: int,
    ) -> Touch | None:
        """Touch from decoded bricks, after reading absent ones; None as for `_frame`."""
        memory, known, counts = self._memory_for(exclude, reads), self.known, NO_QUERY
        total = len(shell.points)
        placed, at = np.empty((total + 1, 6)), np.empty((2, total), dtype=np.int64)
        result, indices = np.empty(6 + 2 * total), np.empty(2 * total, dtype=np.int64)
        while True:
            n_hits, n_apart, n_ids = brick_kernels.touch_bricks(
                shell.points, shell.normals, shell.center, pose, self.grid, memory.directory,
                memory.decoded, exclude, memory.number, law.for_kernels, counts is NO_QUERY,
                placed, at, result, indices,
            )  # fmt: skip
            if n_hits != brick_kernels.INCOMPLETE:
                break
            keys = indices[:n_apart]
            rows, counts = self._fetched(keys, reads)
            if self.store.version() != known.version:
                return None
            if not memory.enter(keys, rows):
                if not memory.n_kept:  # more than fits: `keys` are all of the frame's
                    located = locate(shell, pose, self.grid)
                    return self._over_rows(located, rows, counts, exclude, law, started)
                memory.clear()
        if n_hits == brick_kernels.NOT_RIGID:
            raise _not_rigid()
        query = Query(*counts, (time.perf_counter_ns() - started) / 1000)
        apart = indices[total : total + n_apart], result[6 + total : 6 + total + n_apart]
        return Touch(
            result[:3], result[3:6], indices[:n_hits], result[6 : 6 + n_hits],
            memory.decoded["found"][:n_ids].tolist(), law, query, apart, placed,
            partial(self._pairs_of, memory.rows(placed, at), exclude), known.by_id,
        )  # fmt: skip

    def _memory_for(self, exclude: Keys, reads: bool) -> BrickCache:  # noqa: FBT001 - private
        """Bricks of the cached objects; made at the first frame, because it loads kernels."""
        if self._memory is None:
            self._memory = BrickCache(self.store.url)
        self._memory.choose(self.known.by_id, exclude, reads=reads)
        return self._memory

    def _fetched(self, keys: Keys, reads: bool) -> tuple[Rows, QueryCounts]:  # noqa: FBT001 - private
        """Rows of keys (U,), and the figures of their query."""
        ranges = None
        if len(keys) >= self._least_grouped and self._group is not None:
            ranges = self._group(keys, reads)  # independent of earlier frames
        if ranges is None or KEYS_PER_RANGE * len(ranges.lows) > len(keys):
            rows = self.store.lookup(keys, distances=reads)
            return rows, ("array", 1, len(keys), len(rows.keys))
        rows = self.store.scan(*ranges, distances=reads)
        return rows, ("cbgroup", 1, len(ranges.lows), len(rows.keys))

    def _over_rows(
        self,
        located: "shell_keys.Located",
        rows: Rows,
        counts: QueryCounts,
        exclude: Keys,
        law: ForceLaw,
        started: int,
    ) -> Touch:
        """Touch from the rows of a frame, decoded for it alone."""
        reads = laws.reads_distances(law.for_kernels)
        payload = self.distances_of(rows, located.keys) if reads else None
        return self.refined(located, rows, payload, exclude, law, counts, started)

    def distances_of(self, rows: Rows, keys: Keys) -> NDArray[np.uint8]:
        """Distances (R, 1000) of rows, unset beyond `keys`; UsageError without distances."""
        if not rows.keys.size:
            return np.empty((0, lattice.ROW_VALUES), dtype=np.uint8)
        if rows.distances is None:
            raise UsageError(
                f"{self.store.url} has no distances to surfaces, which this law reads: give "
                "the law TangentPlane"
            )
        try:
            return packing.unpack(*rows.distances, refining.requested_rows(keys, rows.keys))
        except ValueError as error:
            raise damaged(self.store.url, str(error)) from error

    def refined(
        self,
        located: "shell_keys.Located",
        rows: Rows,
        payload: NDArray[np.uint8] | None,
        exclude: Keys,
        law: ForceLaw,
        counts: QueryCounts,
        started: int,
    ) -> Touch:
        """Touch from the rows of a frame, possibly mixed with rows of other poses.

        payload : distances (R, 1000) of the rows, if the law reads any; started : of the frame, ns.
        """
        row_keys, row_ids, occupancy, _ = rows
        total = located.addresses.shape[1]
        result = np.empty(6 + 2 * total)
        indices = np.empty(2 * total + len(row_ids), dtype=np.int64)
        n_hits, n_apart, n_ids = refining.refine(
            *located, row_keys, row_ids, occupancy, payload, exclude, self.grid,
            law.for_kernels, result, indices,
        )  # fmt: skip

        def source(reads: bool) -> LocatedRows:  # noqa: FBT001 - as `Source`
            return located, rows, self.distances_of(rows, located.keys) if reads else None

        query = Query(*counts, (time.perf_counter_ns() - started) / 1000)
        apart = indices[total : total + n_apart], result[6 + total : 6 + total + n_apart]
        return Touch(
            result[:3], result[3:6], indices[:n_hits], result[6 : 6 + n_hits],
            indices[2 * total : 2 * total + n_ids].tolist(), law, query, apart, located.placed,
            partial(self._pairs_of, source, exclude), self.known.by_id,
        )  # fmt: skip

    def _pairs_of(
        self, source: Source, exclude: Keys, law: ForceLaw, points: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """All pairs (P, 2) of a point and an object in contact under a law, of some points."""
        reads = laws.reads_distances(law.for_kernels)
        law = law if reads else PLANE  # laws without distances touch the objects of hits
        located, (keys, ids, occupancy, _), payload = source(reads)
        return refining.pairs_of_points(  # type: ignore[no-any-return]
            *located, keys, ids, occupancy, payload, exclude, self.grid, law.for_kernels, points
        )

    def run_many(
        self, shell: "PointShell", poses: NDArray[np.float64], exclude: Keys, law: ForceLaw
    ) -> Iterator[Touch]:
        """Touches at rigid poses (n, 4, 4), in a snapshot; one statement reads for many of them."""
        self.known.refresh()
        most = max(MOST_POINTS // max(len(shell), 1), 1)
        for start in range(0, len(poses), most):
            located = [locate(shell, pose, self.grid) for pose in poses[start : start + most]]
            keys = np.unique(np.concatenate([one.keys for one in located]))
            if not self._has_bricks:
                yield from self._over_voxels(located, keys, exclude, law)
                continue
            self._read_ahead(keys, exclude, law)
            for pose in poses[start : start + most]:
                touch = self._frame(shell, pose, None, exclude, law)
                assert touch is not None  # noqa: S101 - a snapshot is of one revision
                yield touch

    def _read_ahead(self, keys: Keys, exclude: Keys, law: ForceLaw) -> None:
        """Read absent bricks of keys (U,) into memory, if they fit."""
        reads = laws.reads_distances(law.for_kernels)
        memory = self._memory_for(exclude, reads)
        absent = memory.absent(keys)
        memory.enter(absent, self.store.lookup(absent, distances=reads))

    def _over_voxels(
        self, batch: "list[shell_keys.Located]", keys: Keys, exclude: Keys, law: ForceLaw
    ) -> Iterator[Touch]:
        """Touches over voxel rows, in their order; one statement fetches the rows of all poses."""
        started = time.perf_counter_ns()
        fetched = self.store.lookup(keys)
        counts: QueryCounts = ("array", 1, len(keys), len(fetched))
        for located in batch:
            low = high = 0
            if located.keys.size:
                # methods: numpy's functions of the same name take twice as long, 1 us each
                low = int(fetched.keys.searchsorted(located.keys[0], "left"))
                high = int(fetched.keys.searchsorted(located.keys[-1], "right"))
            rows = fetched.part(low, high)
            yield self.refined(located, rows, None, exclude, law, counts, started)
            counts, started = NO_QUERY, time.perf_counter_ns()


def locate(
    shell: "PointShell", pose: NDArray[np.float64], grid: NDArray[np.void]
) -> "shell_keys.Located":
    """Place a shell at a rigid pose, else UsageError, and compute its row keys; grid of `GRID`."""
    total = len(shell.points)
    # an array returned by a kernel costs twice as much as an argument
    placed, addresses = np.empty((total + 1, 6)), np.empty((2, total), dtype=np.int64)
    keys = np.empty(total, dtype=np.int64)
    count = shell_keys.locate(
        shell.points, shell.normals, shell.center, pose, grid, placed, addresses, keys
    )
    if count < 0:
        raise _not_rigid()
    return shell_keys.Located(placed, addresses, keys[:count])


def _not_rigid() -> UsageError:
    return UsageError("a pose that is no rigid transform: give finite numbers and a rotation")


def as_pose(pose: ArrayLike) -> NDArray[np.float64]:
    """A pose as an array (4, 4) of float64; UsageError for other shapes."""
    given = as_floats(pose, "a pose")
    if given.shape != (4, 4):
        raise UsageError(f"a pose of shape {given.shape}: give a 4 x 4 matrix, world_from_tool")
    return given


def as_poses(poses: ArrayLike) -> NDArray[np.float64]:
    """Poses as an array (n, 4, 4) of float64; UsageError for other shapes."""
    given = as_floats(poses, "poses")
    if given.size == 0 and given.ndim < 3:  # an empty list
        given = given.reshape(0, 4, 4)
    if given.ndim != 3 or given.shape[1:] != (4, 4):
        raise UsageError(
            f"poses of shape {given.shape}: give (n, 4, 4) matrices, world_from_tool; touch takes "
            "a single one"
        )
    return given


def as_id(object_id: int) -> int:
    """An object's id as a plain int; UsageError for other types."""
    try:
        if isinstance(object_id, bool):
            raise TypeError  # noqa: TRY301 - a bool is an int to Python, but no id
        plain = operator.index(object_id)
    except TypeError as error:
        raise UsageError(
            f"object id {object_id!r}: give an int, as objects() lists them"
        ) from error
    if not -(1 << 63) <= plain < 1 << 63:
        raise ObjectNotFoundError(f"no object {plain}: objects() lists those that are there")
    return plain


def as_ids(exclude: Iterable[int]) -> NDArray[np.int64]:
    """Object ids as an array for kernels, ascending and distinct."""
    if not isinstance(exclude, Iterable) or isinstance(exclude, (bytes, bytearray, memoryview)):
        raise UsageError(f"exclude {exclude!r}: give ids in a list")
    return np.array(sorted({as_id(i) for i in exclude}), dtype=np.int64)
