"""The haptic query: plan, fetch, refine (the paper, section 4.2)."""

import operator
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import ObjectNotFoundError, UsageError
from hapticdb.kernels.query import contact
from hapticdb.poses import as_floats
from hapticdb.query.auto import Choice, Chooser, Chosen
from hapticdb.query.grouping import DEFAULT_MAXGAP, cbgroup, maxgap
from hapticdb.query.law import TangentPlane
from hapticdb.store.base import Frame, Keys, Rows, Store, SupportsStatement, row_shift

if TYPE_CHECKING:
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.query.cost_model import CostModel
    from hapticdb.query.quantiles import QuantileVector

Strategy = Literal["auto", "statement", "array", "points", "maxgap", "cbgroup"]
STRATEGIES: tuple[Strategy, ...] = get_args(Strategy)
MOST_SHELLS = 64
"""Sizes of shells for which `auto` remembers what it has learned."""
MOST_KEYS = 2048
"""Row keys of neighbouring poses that one statement asks for: each pose goes over the rows found
between its first key and its last, so that more would save statements and cost time."""
MOST_POINTS = 1 << 17
"""Points of poses that are placed before the database is asked: 12 MB."""
NOTHING_EXCLUDED = np.empty(0, dtype=np.int64)


class Query(NamedTuple):
    """How a frame asked the database.

    strategy : what was used (`auto` names its choice); statements : SQL statements run; ranges :
    index ranges they named, each key of a point query counting as one; rows : rows read, false hits
    included; elapsed_us : the whole frame, microseconds.
    """

    strategy: str
    statements: int
    ranges: int
    rows: int
    elapsed_us: float


class Answer(NamedTuple):
    """What a frame found, before it is given to a person.

    wrench (6,) N and N m; hits (H,) indices, ascending; depths (H,) metres; ids : objects of all
    hits, ascending; pairs : () -> (P, 2) int64, every (hit, object id), computed when asked for.
    """

    wrench: NDArray[np.float64]
    hits: NDArray[np.int64]
    depths: NDArray[np.float64]
    ids: list[int]
    pairs: Callable[[], NDArray[np.int64]]
    query: Query


class HapticQuery:
    """Frames against one store. Keeps what does not change between them.

    Parameters
    ----------
    store : Store
        The opened environment.
    statistics : callable
        Returns the quantile vector and the cost model; called when a strategy first needs them.
    """

    def __init__(
        self, store: Store, statistics: "Callable[[], tuple[QuantileVector, CostModel]]"
    ) -> None:
        self._store = store
        self._statistics = statistics
        self._choosers: dict[int, Chooser] = {}
        grid = store.grid
        self._shift = row_shift(store.layout)
        self._origin = np.array(grid.origin)
        self._size = grid.voxel_size
        self._curve = (grid.bits, grid.curve_code, self._shift)

    def run(
        self,
        shell: "PointShell",
        world_from_tool: ArrayLike,
        strategy: Strategy = "auto",
        gap: int = DEFAULT_MAXGAP,
        exclude: Keys = NOTHING_EXCLUDED,
        law: TangentPlane = TangentPlane(),  # noqa: B008 - frozen, and a frame counts microseconds
    ) -> Answer:
        """Look a shell up at one pose; see `hapticdb.environment.Environment.touch`."""
        started = time.perf_counter_ns()
        _check_options(strategy, gap)
        pose = as_floats(world_from_tool, "a pose")
        located = self.locate(shell, pose)
        if strategy == "auto" and not located.keys.size:
            strategy = "array"  # nothing to ask: the tool is beside the grid
        if strategy == "auto":
            chooser = self._choosers.get(located.asked.shape[1])
            kept = chooser.kept(len(located.keys)) if chooser is not None else None
            if chooser is None or kept is None:
                return self._choosing(located, exclude, law, started)
            if chooser.is_listening:
                return self._heard(chooser, kept, located, exclude, law, started)
            strategy = kept
        return self._answer(strategy, located, exclude, law, started, gap)

    def _choosing(
        self, located: "contact.Located", exclude: Keys, law: TangentPlane, started: int
    ) -> Answer:
        """The first frame of a turn: its strategy is chosen, and the rows that it reads told."""
        n_points = located.asked.shape[1]
        chooser = self._present_chooser(n_points)
        choice = chooser.choose(n_points, located.keys)
        answer = self._answer(choice.strategy, located, exclude, law, started)
        chooser.find(choice, answer.query.rows)
        return answer

    def _heard(
        self,
        chooser: Chooser,
        strategy: Chosen,
        located: "contact.Located",
        exclude: Keys,
        law: TangentPlane,
        started: int,
    ) -> Answer:
        """The last frame of a turn: it is timed."""
        asking = time.perf_counter_ns()
        answer = self._answer(strategy, located, exclude, law, started)
        took_us = (time.perf_counter_ns() - asking) / 1000
        query = answer.query
        n_points, n_keys = located.asked.shape[1], len(located.keys)
        chooser.hear(Choice(strategy, n_points, n_keys, query.ranges, query.rows), took_us)
        return answer

    def _answer(
        self,
        strategy: Strategy,
        located: "contact.Located",
        exclude: Keys,
        law: TangentPlane,
        started: int,
        gap: int = DEFAULT_MAXGAP,
    ) -> Answer:
        """Rows fetched, false hits dropped, the wrench summed."""
        if strategy == "statement":
            return self._by_statement(located, exclude, law, started)
        n_statements, n_ranges, rows = self._fetch(strategy, located, gap)
        query = Query(strategy, n_statements, n_ranges, len(rows[0]), 0.0)
        return self._refined(located, rows, exclude, law, query, started)

    def _refined(
        self,
        located: "contact.Located",
        rows: Rows,
        exclude: Keys,
        law: TangentPlane,
        query: Query,
        started: int,
    ) -> Answer:
        """What a frame found in rows that were fetched for it, and perhaps for others."""
        placed, asked, keys = located
        row_keys, row_ids, occupancy = rows
        wrench, hits, depths, ids = contact.refine(
            placed,
            asked,
            keys,
            row_keys,
            row_ids,
            occupancy,
            exclude,
            self._origin,
            self._size,
            law.stiffness,
        )
        pairs = partial(
            contact.pairs_of_hits, asked, keys, row_keys, row_ids, occupancy, exclude, hits
        )
        query = query._replace(elapsed_us=(time.perf_counter_ns() - started) / 1000)
        return Answer(wrench, hits, depths, ids.tolist(), pairs, query)

    def run_many(
        self,
        shell: "PointShell",
        poses: NDArray[np.float64],
        strategy: Strategy,
        gap: int,
        exclude: Keys,
        law: TangentPlane,
    ) -> Iterator[Answer]:
        """Answers at poses (n, 4, 4), in their order; see `Environment.touch_many`.

        A statement that serves several poses is counted with the first of them.
        """
        _check_options(strategy, gap)
        batch: list[contact.Located] = []
        n_keys, most = 0, max(MOST_POINTS // max(len(shell), 1), 1)
        for n, pose in enumerate(poses):
            try:
                if strategy != "auto":
                    yield self.run(shell, pose, strategy, gap, exclude, law)
                    continue
                batch.append(self.locate(shell, pose))
            except UsageError as error:
                raise UsageError(f"pose {n}: {error}") from error
            n_keys += len(batch[-1].keys)
            if n_keys >= MOST_KEYS or len(batch) >= most:
                yield from self._together(batch, exclude, law)
                batch, n_keys = [], 0
        if batch:
            yield from self._together(batch, exclude, law)

    def _together(
        self, batch: "list[contact.Located]", exclude: Keys, law: TangentPlane
    ) -> Iterator[Answer]:
        """Answers of poses whose rows are fetched by one statement."""
        started = time.perf_counter_ns()
        keys = np.unique(np.concatenate([located.keys for located in batch]))
        row_keys, row_ids, occupancy = self._store.lookup(keys)
        query = Query("array", 1, len(keys), len(row_keys), 0.0)
        for located in batch:
            low = high = 0
            if located.keys.size:
                low = int(np.searchsorted(row_keys, located.keys[0], "left"))
                high = int(np.searchsorted(row_keys, located.keys[-1], "right"))
            rows = Rows(row_keys[low:high], row_ids[low:high], occupancy[64 * low : 64 * high])
            yield self._refined(located, rows, exclude, law, query, started)
            query, started = Query("array", 0, 0, 0, 0.0), time.perf_counter_ns()

    def locate(self, shell: "PointShell", pose: NDArray[np.float64]) -> "contact.Located":
        """Place a shell (N points) at a pose (4, 4), and find the row keys that it asks for."""
        if pose.shape != (4, 4):
            raise UsageError(f"a pose of shape {pose.shape}: give a 4 x 4 matrix, world_from_tool")
        bits, curve, shift = self._curve
        try:
            return contact.locate(
                shell.points,
                shell.normals,
                shell.center,
                pose,
                self._origin,
                self._size,
                bits,
                curve,
                shift,
            )
        except ValueError as error:
            raise UsageError(f"{error}: give finite numbers and a rotation") from error

    def _fetch(
        self, strategy: Strategy, located: "contact.Located", gap: int
    ) -> tuple[int, int, Rows]:
        """Statements, ranges and rows of a frame."""
        _, asked, keys = located
        if strategy == "array":
            return 1, len(keys), self._store.lookup(keys)
        if strategy == "points":
            with self._store.snapshot():
                return len(keys), len(keys), self._store.lookup_each(keys)
        if strategy == "maxgap":
            first, last = contact.spans_of_keys(asked, keys, *self._curve)
            ranges = maxgap(keys, first, last, gap)
        else:
            ranges = cbgroup(keys, *self._statistics()).ranges
        return 1, len(ranges.lows), self._store.scan(*ranges)

    def _present_chooser(self, n_points: int) -> Chooser:
        """The one for such a shell that stands on the present statistics.

        One for each size of shell: two tools in turns would never be alike.
        """
        quantiles, costs = self._statistics()
        chooser = self._choosers.get(n_points)
        if chooser is None or chooser.quantiles is not quantiles or chooser.costs is not costs:
            if len(self._choosers) >= MOST_SHELLS:
                self._choosers.clear()
            self._choosers[n_points] = chooser = Chooser(quantiles, costs)
        return chooser

    def _by_statement(
        self,
        located: "contact.Located",
        exclude: Keys,
        law: TangentPlane,
        started: int,
    ) -> Answer:
        """Figure 3, and the second statement for what EXISTS drops, in one snapshot."""
        store = self._store
        if not isinstance(store, SupportsStatement):
            raise UsageError(f"{store.url} cannot compute force() inside: choose another strategy")
        placed, (addresses, _), _ = located
        frame = Frame(placed, addresses, law.stiffness, exclude)
        with store.snapshot():
            wrench = store.statement(frame)
            ordinals, ids = store.statement_hits(frame)
        pairs = np.stack([ordinals, ids], axis=1)
        hits = np.unique(ordinals)
        depths = contact.depths_of_hits(placed, hits, self._origin, self._size)
        touched = np.unique(ids).tolist()
        elapsed_us = (time.perf_counter_ns() - started) / 1000
        query = Query("statement", 2, len(addresses), len(ids), elapsed_us)
        order = np.lexsort((ids, ordinals))
        return Answer(wrench, hits, depths, touched, lambda: pairs[order], query)


def _check_options(strategy: Strategy, gap: int) -> None:
    if strategy not in STRATEGIES:
        raise UsageError(f"strategy {strategy!r}: choose one of {', '.join(STRATEGIES)}")
    if gap < 0:
        raise UsageError(f"MAXGAP {gap}: give 0 or more")


def as_poses(poses: ArrayLike) -> NDArray[np.float64]:
    """Poses as an array (n, 4, 4) of float64; refuses other shapes."""
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
    """An object's id as a plain int; refuses what is none."""
    try:
        if isinstance(object_id, bool):
            raise TypeError  # noqa: TRY301 - no id, though Python counts it among the integers
        plain = operator.index(object_id)
    except TypeError as error:
        raise UsageError(
            f"object id {object_id!r}: give an int, as objects() lists them"
        ) from error
    if not -(1 << 63) <= plain < 1 << 63:
        raise ObjectNotFoundError(f"no object {plain}: objects() lists those that are there")
    return plain


def as_ids(exclude: Iterable[int]) -> NDArray[np.int64]:
    """Ids of objects, ascending and distinct, as kernels take them."""
    if not isinstance(exclude, Iterable) or isinstance(exclude, (bytes, bytearray, memoryview)):
        raise UsageError(f"exclude {exclude!r}: give ids in a list")
    return np.array(sorted({as_id(i) for i in exclude}), dtype=np.int64)
