"""The haptic query: plan, fetch, refine (the paper, section 4.2)."""

import operator
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import ObjectNotFoundError, UsageError
from hapticdb.kernels import law as laws
from hapticdb.kernels.field import lattice
from hapticdb.kernels.query import contact, refining
from hapticdb.poses import as_floats
from hapticdb.query.auto import grouping_threshold, ranges_worth_scanning
from hapticdb.query.grouping import DEFAULT_MAXGAP, Ranges, cbgroup, maxgap
from hapticdb.query.law import PLANE, ForceLaw, TangentPlane, frames_by
from hapticdb.ready import make_ready
from hapticdb.store.base import Keys, LocatedShell, Rows, Store, SupportsStatement, row_shift
from hapticdb.store.parsing import damaged

if TYPE_CHECKING:
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.query.cost_model import CostModel
    from hapticdb.query.quantiles import QuantileVector

Strategy = Literal["auto", "statement", "array", "points", "maxgap", "cbgroup"]
STRATEGIES: tuple[Strategy, ...] = get_args(Strategy)
MOST_KEYS = 2048
"""Row keys of successive poses after which one statement is sent for all of them. A larger value
sends fewer statements, but then there are more rows of other poses among the rows of each pose."""
MOST_POINTS = 1 << 17
"""Most shell points, summed over the poses that one statement serves: 12 MB. A larger value takes
more memory."""
NOTHING_EXCLUDED = np.empty(0, dtype=np.int64)
NO_POINTS = np.empty(0, dtype=np.int64)
NO_DEPTHS = np.empty(0)


class Query(NamedTuple):
    """How a frame asked the database.

    strategy : the strategy used, never `auto`; statements : SQL statements run; ranges : index
    ranges in these statements, each single key is one; rows : rows read, false hits included;
    elapsed_us : time of the whole frame, microseconds.
    """

    strategy: str
    statements: int
    ranges: int
    rows: int
    elapsed_us: float


_Asked = tuple[Strategy, int, int, int]
"""Fields of `Query` without the last, which is known only at the end of a frame."""


class Answer(NamedTuple):
    """The result of a frame; users get it as a `Touch`.

    wrench (6,) N and N m; hits (H,) indices, ascending; depths (H,) metres; ids : objects of all
    hits, ascending; pairs : () -> (P, 2) int64, every (hit, object id), computed when asked for;
    placed (N + 1, 6) : the shell's points in metres and normals, world frame, last its centre;
    touched : contacts (C,) -> (P, 2) int64, every (contact, object id), under a law that reads
    distances; None where contacts are hits;
    apart (A,) : indices of felt points that are no hits, ascending; apart_depths (A,) metres.
    """

    wrench: NDArray[np.float64]
    hits: NDArray[np.int64]
    depths: NDArray[np.float64]
    ids: list[int]
    pairs: Callable[[], NDArray[np.int64]]
    query: Query
    placed: NDArray[np.float64]
    law: ForceLaw
    touched: Callable[[NDArray[np.int64]], NDArray[np.int64]] | None = None
    apart: NDArray[np.int64] = NO_POINTS
    apart_depths: NDArray[np.float64] = NO_DEPTHS

    def contacts(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Indices (C,) of the points that are felt, ascending, and their depths (C,), above 0."""
        is_felt = self.depths > 0
        points, depths = self.hits[is_felt], self.depths[is_felt]
        if self.apart.size:
            points = np.concatenate([points, self.apart])
            order = np.argsort(points)
            points, depths = points[order], np.concatenate([depths, self.apart_depths])[order]
        return points, depths


class HapticQuery:
    """Runs frames against one store.

    Parameters
    ----------
    store : Store
        The opened environment.
    quantiles_and_costs : callable
        Returns the quantile vector and the cost model; called for each frame that is grouped by
        cost.
    """

    def __init__(
        self, store: Store, quantiles_and_costs: "Callable[[], tuple[QuantileVector, CostModel]]"
    ) -> None:
        self._store = store
        self._quantiles_and_costs = quantiles_and_costs
        self._grouping_threshold = grouping_threshold(store)
        self._shift = row_shift(store.layout)
        self._grid = store.grid.for_kernels(self._shift)

    def run(
        self,
        shell: "PointShell",
        world_from_tool: ArrayLike,
        strategy: Strategy = "auto",
        gap: int = DEFAULT_MAXGAP,
        exclude: Keys = NOTHING_EXCLUDED,
        law: ForceLaw = TangentPlane(),  # noqa: B008 - frozen, and a frame counts microseconds
    ) -> Answer:
        """Look a shell up at one pose; see `hapticdb.environment.Environment.touch`."""
        make_ready("statement" if strategy == "statement" else frames_by(law, "touch"))
        if strategy in {"maxgap", "cbgroup"}:
            make_ready("calibrate")
        started = time.perf_counter_ns()
        if strategy not in STRATEGIES:
            raise UsageError(f"strategy {strategy!r}: choose one of {', '.join(STRATEGIES)}")
        if gap < 0:
            raise UsageError(f"MAXGAP {gap}: give 0 or more")
        located = self.locate(shell, as_floats(world_from_tool, "a pose"))
        if strategy == "statement":
            return self._by_statement(located, exclude, law, started)
        distances = laws.reads_distances(law.for_kernels)
        asked, rows = self._fetch(strategy, located, gap, distances=distances)
        payload = self._distances_of(rows, located.keys) if distances else None
        return self._refined(located, rows, payload, exclude, law, asked, started)

    def _distances_of(self, rows: Rows, keys: Keys) -> NDArray[np.uint8]:
        """Distances (R, 1000) of rows. Rows whose keys are not among `keys` are left unset.

        Raises
        ------
        UsageError
            If the rows have no distances.
        """
        if not rows.keys.size:
            return np.empty((0, lattice.ROW_VALUES), dtype=np.uint8)
        if rows.distances is None:
            raise UsageError(
                f"{self._store.url} has no distances to surfaces, which this law reads: give "
                "the law TangentPlane"
            )
        try:
            return refining.unpack_asked(keys, rows.keys, *rows.distances)
        except ValueError as error:
            raise damaged(self._store.url, str(error)) from error

    def _refined(
        self,
        located: "contact.Located",
        rows: Rows,
        payload: NDArray[np.uint8] | None,
        exclude: Keys,
        law: ForceLaw,
        query: _Asked,
        started: int,
    ) -> Answer:
        """Answer of a frame from its rows; rows of other poses may lie among them."""
        row_keys, row_ids, occupancy, _ = rows
        wrench, hits, depths, ids, apart, apart_depths = refining.refine(
            located, row_keys, row_ids, occupancy, payload, exclude, self._grid, law.for_kernels
        )
        elapsed_us = (time.perf_counter_ns() - started) / 1000
        return Answer(
            wrench,
            hits,
            depths,
            ids.tolist(),
            partial(self._touched, located, rows, exclude, PLANE, hits),
            Query(*query, elapsed_us),
            located.placed,
            law,
            None if payload is None else partial(self._touched, located, rows, exclude, law),
            apart,
            apart_depths,
        )

    def _touched(
        self,
        located: "contact.Located",
        rows: Rows,
        exclude: Keys,
        law: ForceLaw,
        points: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """Every (point, object) pair (P, 2) of points of a frame: of its hits under the plane."""
        make_ready(frames_by(law, "pairs"))
        reads = laws.reads_distances(law.for_kernels)
        payload = self._distances_of(rows, located.keys) if reads else None
        keys, ids, occupancy, _ = rows
        return refining.pairs_of_points(  # type: ignore[no-any-return]
            *located, keys, ids, occupancy, payload, exclude, self._grid, law.for_kernels, points
        )

    def run_many(
        self,
        shell: "PointShell",
        poses: NDArray[np.float64],
        exclude: Keys,
        law: ForceLaw,
    ) -> Iterator[Answer]:
        """Answers at poses (n, 4, 4), in their order; one statement reads the rows of several.

        Such a statement is counted in the first pose's answer only.
        """
        make_ready(frames_by(law, "touch"))
        batch: list[contact.Located] = []
        n_keys, most = 0, max(MOST_POINTS // max(len(shell), 1), 1)
        for pose in poses:
            batch.append(self.locate(shell, pose))
            n_keys += len(batch[-1].keys)
            if n_keys >= MOST_KEYS or len(batch) >= most:
                yield from self._look_up_together(batch, exclude, law)
                batch, n_keys = [], 0
        if batch:
            yield from self._look_up_together(batch, exclude, law)

    def _look_up_together(
        self, batch: "list[contact.Located]", exclude: Keys, law: ForceLaw
    ) -> Iterator[Answer]:
        """Answers of poses, in their order; one statement fetches the rows of all poses."""
        started = time.perf_counter_ns()
        keys = np.unique(np.concatenate([located.keys for located in batch]))
        reads = laws.reads_distances(law.for_kernels)
        fetched = self._store.lookup(keys, distances=reads)
        query: _Asked = ("array", 1, len(keys), len(fetched))
        row_keys = fetched.keys
        distances = self._distances_of(fetched, keys) if reads else None
        for located in batch:
            low = high = 0
            if located.keys.size:
                # methods, since numpy's functions of the same name take twice as long, 1 us each
                low = int(row_keys.searchsorted(located.keys[0], "left"))
                high = int(row_keys.searchsorted(located.keys[-1], "right"))
            rows = fetched.part(low, high)
            payload = None if distances is None else distances[low:high]
            yield self._refined(located, rows, payload, exclude, law, query, started)
            query, started = ("array", 0, 0, 0), time.perf_counter_ns()

    def locate(self, shell: "PointShell", pose: NDArray[np.float64]) -> "contact.Located":
        """Place a shell (N points) at a pose (4, 4), and compute the row keys to ask for."""
        if pose.shape != (4, 4):
            raise UsageError(f"a pose of shape {pose.shape}: give a 4 x 4 matrix, world_from_tool")
        points, normals, center = shell.points, shell.normals, shell.center
        try:
            return contact.locate(points, normals, center, pose, self._grid)
        except ValueError as error:
            raise UsageError(f"{error}: give finite numbers and a rotation") from error

    def _figures(self, *, distances: bool) -> "tuple[QuantileVector, CostModel]":
        """Quantile vector, and the cost model of rows with their distances or without."""
        make_ready("calibrate")
        quantiles, costs = self._quantiles_and_costs()
        return quantiles, costs.with_distances if distances else costs

    def _fetch(
        self, strategy: Strategy, located: "contact.Located", gap: int, *, distances: bool
    ) -> tuple[_Asked, Rows]:
        """Rows of a frame, and the fields of `Query` that say how they were asked for."""
        _, asked, keys = located
        if strategy == "points":
            with self._store.snapshot():
                rows = self._store.lookup_each(keys, distances=distances)
            return ("points", len(keys), len(keys), len(rows)), rows
        ranges: Ranges | None = None
        if strategy == "maxgap":
            first, last = contact.spans_of_keys(asked, keys, self._grid)
            ranges = maxgap(keys, first, last, gap)
        elif strategy == "cbgroup":
            ranges = cbgroup(keys, *self._figures(distances=distances))
        elif strategy == "auto":
            figures = partial(self._figures, distances=distances)
            ranges = ranges_worth_scanning(keys, self._grouping_threshold, figures)
            strategy = "array" if ranges is None else "cbgroup"
        if ranges is None:
            rows = self._store.lookup(keys, distances=distances)
            return ("array", 1, len(keys), len(rows)), rows
        rows = self._store.scan(*ranges, distances=distances)
        return (strategy, 1, len(ranges.lows), len(rows)), rows

    def _by_statement(
        self,
        located: "contact.Located",
        exclude: Keys,
        law: ForceLaw,
        started: int,
    ) -> Answer:
        """Run Figure 3, and a second statement for the ids that EXISTS drops, in one snapshot."""
        store = self._store
        if not isinstance(law, TangentPlane):
            raise UsageError(
                "the strategy 'statement' computes the tangent-plane law alone: give the law "
                "'plane', or choose another strategy"
            )
        if not isinstance(store, SupportsStatement):
            raise UsageError(f"{store.url} cannot compute force() inside: choose another strategy")
        placed, (addresses, _), _ = located
        frame = LocatedShell(placed, addresses, law.stiffness, exclude)
        with store.snapshot():
            wrench = store.statement(frame)
            ordinals, ids = store.statement_hits(frame)
        pairs = np.stack([ordinals, ids], axis=1)
        hits = np.unique(ordinals)
        depths = np.empty(len(hits))
        refining.wrench_of_addresses(
            placed, hits, addresses[hits], self._grid, law.for_kernels, depths
        )
        touched = np.unique(ids).tolist()
        elapsed_us = (time.perf_counter_ns() - started) / 1000
        query = Query("statement", 2, len(addresses), len(ids), elapsed_us)
        order = np.lexsort((ids, ordinals))
        return Answer(wrench, hits, depths, touched, lambda: pairs[order], query, placed, law)


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
    """An object's id as a plain int; refuses what is not an integer."""
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
