"""The quantile vector: an equi-count histogram of the row keys (the paper, section 5)."""

from dataclasses import dataclass
from functools import cached_property

from hapticdb.errors import UsageError
from hapticdb.kernels.query import key_ranges
from hapticdb.store.base import Keys, Store, row_shift
from hapticdb.store.parsing import damaged

DEFAULT_RESOLUTION = 10_000
"""Buckets of the quantile vector: the paper's best value. Larger: more exact, slower to make."""
MAX_RESOLUTION = 1_000_000
"""Largest resolution: 8 MB."""


@dataclass(frozen=True)
class QuantileVector:
    """Equi-count histogram of the row keys (the paper's Definition 2).

    bounds (R + 1,) int64 : ascending; bound i is the key of the row of rank ceil(i N / R), bound 0
    the lowest key; n_rows : N, rows of the index table; source : of the bounds:
    ``computed``, ``kept`` since the last write, or the engine's own ``server statistics``.
    """

    bounds: Keys
    n_rows: int
    source: str = "computed"

    @cached_property
    def resolution(self) -> int:
        """R, the number of buckets."""
        return len(self.bounds) - 1

    @cached_property
    def rows_per_bucket(self) -> float:
        """Number of rows in each bucket."""
        return self.n_rows / self.resolution

    def rows_between(self, left: int, right: int) -> float:
        """Expected rows with a key in [left, right]. Rows of neighbouring ranges add up."""
        return float(key_ranges.gap_rows(left, right, self.bounds, self.rows_per_bucket))

    @classmethod
    def of(cls, store: Store, resolution: int = DEFAULT_RESOLUTION) -> "QuantileVector":
        """Quantile vector of all rows of an environment."""
        if not 1 <= resolution <= MAX_RESOLUTION:
            raise UsageError(f"{resolution} quantiles: give 1 to {MAX_RESOLUTION}")
        found = store.quantiles(resolution)
        key_end = 1 << max(3 * store.grid.bits - row_shift(store.layout), 0)
        if found.n_rows and not 0 <= found.bounds[0] <= found.bounds[-1] < key_end:
            raise damaged(store.url, "rows outside the grid")
        return cls(*found)
