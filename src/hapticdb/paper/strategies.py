"""The paper's strategies of a frame's query (sections 4.2 and 5), and the product's own."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from hapticdb.errors import UsageError
from hapticdb.kernels.force_law import reads_distances
from hapticdb.kernels.query import refining, shell_keys
from hapticdb.paper.cost_model import CostModel
from hapticdb.paper.grouping import DEFAULT_MAXGAP, cbgroup, maxgap
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.query.haptic_query import NOTHING_EXCLUDED, HapticQuery, QueryCounts
from hapticdb.query.law import ForceLaw, TangentPlane
from hapticdb.query.touches import Query, Touch
from hapticdb.store.base import Keys, LocatedShell, Rows, Store
from hapticdb.store.covering import Ranges
from hapticdb.store.filtering import ALL, Filter

if TYPE_CHECKING:
    from hapticdb.pointshell.shell import PointShell

Strategy = Literal["auto", "statement", "array", "points", "maxgap", "cbgroup"]
STRATEGIES: tuple[Strategy, ...] = get_args(Strategy)


class Strategies:
    """Frames against one store by any strategy; `auto` is `HapticQuery`'s own.

    quantiles_and_costs : called for each frame that is grouped by cost.
    """

    def __init__(
        self, store: Store, quantiles_and_costs: Callable[[], tuple[QuantileVector, CostModel]]
    ) -> None:
        self.store = store
        self.query = HapticQuery(store, self.grouped)
        self._quantiles_and_costs = quantiles_and_costs
        self._forms: dict[tuple[Strategy, int], _Form] = {}

    def touch(
        self,
        shell: "PointShell",
        pose: ArrayLike,
        strategy: Strategy = "auto",
        gap: int = DEFAULT_MAXGAP,
        selection: Filter = ALL,
        law: ForceLaw | None = None,
    ) -> Touch:
        """Touch of a shell at one pose; see `hapticdb.environment.Environment.touch`."""
        if gap < 0:
            raise UsageError(f"MAXGAP {gap}: give 0 or more")
        form = None
        if strategy != "auto":
            if strategy not in STRATEGIES:
                raise UsageError(f"strategy {strategy!r}: choose one of {', '.join(STRATEGIES)}")
            form = self._forms.setdefault((strategy, gap), _Form(self, strategy, gap))
        return self.query.touch(shell, pose, selection, law, form)

    def grouped(self, keys: Keys, distances: bool) -> Ranges:  # noqa: FBT001 - as `Group`
        """Ranges of row keys (U,) at the least cost; distances : whether these are read, too."""
        quantiles, costs = self._quantiles_and_costs()
        return cbgroup(keys, keys, quantiles, costs.with_distances if distances else costs)


@dataclass(frozen=True, eq=False)
class _Form:
    """Frames by one strategy; gap : MAXGAP of ``maxgap``."""

    frames: Strategies
    strategy: Strategy
    gap: int

    def touch(
        self, located: shell_keys.Located, exclude: Keys, law: ForceLaw, started: int
    ) -> Touch:
        """Touch of a located shell; started : begin of the frame, ns."""
        if self.strategy == "statement":
            return self._by_statement(located, exclude, law, started)
        query, reads = self.frames.query, reads_distances(law.for_kernels)
        rows, statements, n_ranges = self._fetched(located, distances=reads)
        counts: QueryCounts = (self.strategy, statements, n_ranges, len(rows.keys))
        payload = query.distances_of(rows, located.keys) if reads else None
        return query.refined(located, rows, payload, exclude, law, counts, started)

    def _fetched(self, located: shell_keys.Located, *, distances: bool) -> tuple[Rows, int, int]:
        """Rows of a frame, and the numbers of statements and of ranges."""
        store, keys = self.frames.store, located.keys
        if self.strategy == "points":
            with store.snapshot():
                return store.lookup_each(keys, distances=distances), len(keys), len(keys)
        if self.strategy == "array":
            return store.lookup(keys, distances=distances), 1, len(keys)
        if self.strategy == "maxgap":
            first, last = shell_keys.spans_of_keys(located.addresses, keys, self.frames.query.grid)
            ranges = maxgap(keys, first, last, self.gap)
        else:
            ranges = self.frames.grouped(keys, distances)
        return store.scan(*ranges, distances=distances), 1, len(ranges.lows)

    def _by_statement(
        self, located: shell_keys.Located, exclude: Keys, law: ForceLaw, started: int
    ) -> Touch:
        """Run Figure 3, and a second statement for the ids dropped by its EXISTS, in a snapshot."""
        store, query = self.frames.store, self.frames.query
        if not isinstance(law, TangentPlane):
            raise UsageError(
                "the strategy 'statement' computes the tangent-plane law alone: give the law "
                "'plane', or choose another strategy"
            )
        placed, (addresses, _), _ = located
        frame = LocatedShell(placed, addresses, law.stiffness, exclude)
        with store.snapshot():
            wrench = store.statement(frame)
            ordinals, ids = store.statement_hits(frame)
        hits = np.unique(ordinals)
        depths = np.empty(len(hits))
        refining.wrench_of_addresses(
            placed, hits, addresses[hits], query.grid, law.for_kernels, depths
        )
        elapsed_us = (time.perf_counter_ns() - started) / 1000
        figures = Query("statement", 2, len(addresses), len(ids), elapsed_us)
        pairs = np.stack([ordinals, ids], axis=1)[np.lexsort((ids, ordinals))]

        def pairs_of(_: ForceLaw, points: Keys) -> Keys:
            return pairs[np.isin(pairs[:, 0], points)]

        apart = NOTHING_EXCLUDED, depths[:0]
        return Touch(
            wrench[:3], wrench[3:], hits, depths, np.unique(ids).tolist(), law, figures, apart,
            placed, pairs_of, query.known.by_id,
        )  # fmt: skip
