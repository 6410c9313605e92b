"""The haptic query: plan, fetch, refine (the paper, section 4.2)."""

import operator
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import ObjectNotFoundError, UsageError
from hapticdb.force import TangentPlane
from hapticdb.grouping import DEFAULT_MAXGAP, cbgroup, maxgap
from hapticdb.kernels import contact
from hapticdb.kernels.contact import Located
from hapticdb.store.base import Frame, Keys, Rows, Store, SupportsStatement, row_shift

if TYPE_CHECKING:
    from hapticdb.pointshell import PointShell
    from hapticdb.statistics import CostModel, QuantileVector

Strategy = Literal["auto", "statement", "array", "points", "maxgap", "cbgroup"]
STRATEGIES: tuple[Strategy, ...] = get_args(Strategy)
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
        if strategy not in STRATEGIES:
            raise UsageError(f"strategy {strategy!r}: choose one of {', '.join(STRATEGIES)}")
        if gap < 0:
            raise UsageError(f"MAXGAP {gap}: give 0 or more")
        pose = np.ascontiguousarray(world_from_tool, dtype=np.float64)
        located = self._locate(shell, pose)
        if strategy == "statement":
            return self._by_statement(located, exclude, law, started)
        chosen, n_statements, n_ranges, rows = self._fetch(strategy, located, gap)
        if rows is None:
            return self._by_statement(located, exclude, law, started)
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
        elapsed_us = (time.perf_counter_ns() - started) / 1000
        query = Query(chosen, n_statements, n_ranges, len(row_keys), elapsed_us)
        return Answer(wrench, hits, depths, ids.tolist(), pairs, query)

    def _locate(self, shell: "PointShell", pose: NDArray[np.float64]) -> Located:
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
        self, strategy: Strategy, located: Located, gap: int
    ) -> tuple[Strategy, int, int, Rows | None]:
        """Rows of a frame: strategy used, statements, ranges, rows; none for `statement`."""
        _, asked, keys = located
        if strategy == "array":
            return strategy, 1, len(keys), self._store.lookup(keys)
        if strategy == "points":
            with self._store.snapshot():
                return strategy, len(keys), len(keys), self._store.lookup_each(keys)
        if strategy == "maxgap":
            first, last = contact.spans_of_keys(asked, keys, *self._curve)
            ranges = maxgap(keys, first, last, gap)
            return strategy, 1, len(ranges.lows), self._store.scan(*ranges)
        quantiles, costs = self._statistics()
        grouping = cbgroup(keys, quantiles, costs)
        lows, highs = grouping.ranges
        if strategy == "cbgroup":
            return strategy, 1, len(lows), self._store.scan(lows, highs)
        chosen = costs.cheapest(
            asked.shape[1], len(keys), len(lows), grouping.rows_asked, grouping.rows_in_gaps
        )
        if chosen == "cbgroup":
            return chosen, 1, len(lows), self._store.scan(lows, highs)
        if chosen == "statement":
            return chosen, 0, 0, None
        return self._fetch(chosen, located, gap)

    def _by_statement(
        self,
        located: Located,
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


def as_id(object_id: int) -> int:
    """An object's id as a plain int; refuses what is none."""
    try:
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
    if not isinstance(exclude, Iterable):
        raise UsageError(f"exclude {exclude!r}: give ids in a list")
    return np.array(sorted({as_id(i) for i in exclude}), dtype=np.int64)
