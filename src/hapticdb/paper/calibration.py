"""Fit of the cost model to the opened database, by real scans around its own surface."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.query import key_ranges, shell_keys
from hapticdb.paper.cost_model import CostModel
from hapticdb.paper.grouping import cbgroup
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.haptic_query import locate
from hapticdb.store.base import Keys, Store, SupportsCaches, row_shift

Floats = NDArray[np.float64]

CAUTIONS = tuple(2.0**n for n in range(-2, 8))
"""Candidate values of `CostModel.caution`; the one with the least cost is used."""
TOO_MANY_ROWS = 20_000
"""Rows of a statement above which it is not timed: no frame reads so many."""


class _Probe(NamedTuple):
    """Row keys (U,) of a shell, ascending; lowest and highest voxel key (U,) under each."""

    keys: Keys
    first: Keys
    last: Keys


def calibrate(
    store: Store, *, repeats: int = 5, budget: float = 0.5, cold: bool = False
) -> CostModel:
    """Measure the costs of queries on this database, in real scans around its own surface.

    Spheres of shell points of several sizes are placed on occupied voxels drawn by the quantile
    vector. Their keys are scanned in ranges of several widths, and the medians of the times are
    fitted by least squares with non-negative figures.

    store : an environment with at least one row
    repeats : timings of each statement, after an untimed run. Their median is used.
    budget : seconds after which no further position is measured. At least 12 are measured, or 4 if
        that takes eight times as long, as on partitions.
    cold : empty all caches before each query, for the times of frames at new positions

    Raises `UsageError` for an empty environment, and for `cold` on a server, whose caches hapticdb
    cannot empty.
    """
    size = store.size()
    if size.rows == 0:
        raise UsageError(f"{store.url} is empty: import a file before calibrating")
    before: Callable[[], None] | None = None
    if cold:
        if not isinstance(store, SupportsCaches):
            raise UsageError(
                f"{store.url}: a server's caches cannot be emptied from here; leave out cold"
            )
        before = store.drop_caches
    rows_per_block = size.rows / max(size.leaf_blocks, 1)
    quantiles = QuantileVector.of(store)
    trials = _Trials(store, quantiles, 1 if cold else repeats, before)
    started = time.perf_counter()
    for n, probe in enumerate(_probes(store, quantiles)):
        trials.measure(probe)
        took = time.perf_counter() - started
        if (n >= 11 and took > budget) or (n >= 3 and took > 8 * budget):
            break
    return trials.fit(rows_per_block)


class _Trials:
    """Timings of scans at several positions, and their fit."""

    def __init__(
        self,
        store: Store,
        quantiles: QuantileVector,
        repeats: int,
        before: Callable[[], None] | None,
    ) -> None:
        self._store = store
        self._before = before
        self._quantiles = quantiles
        self._repeats = repeats
        self._scans: list[tuple[float, ...]] = []
        self._counts: list[tuple[float, ...]] = []
        self._keys: list[Keys] = []
        self._with_distances = np.zeros(2)

    def measure(self, probe: _Probe) -> None:
        """Time the scans of one shell's keys."""
        store = self._store
        for gap in (0, 1 << 9, 1 << 13, 1 << 16):
            lows, highs = key_ranges.group_by_gap(probe.keys, probe.first, probe.last, gap)
            rows = store.count(lows, highs)
            if rows > TOO_MANY_ROWS:
                continue
            scan = self._time(lambda lo=lows, hi=highs: store.scan(lo, hi))  # type: ignore[misc]
            count = self._time(lambda lo=lows, hi=highs: store.count(lo, hi))  # type: ignore[misc]
            self._scans.append((1, len(lows), rows, scan))
            self._counts.append((1, len(lows), rows, count))
            if store.wants_distances:
                more = self._time(lambda lo=lows, hi=highs: store.scan(lo, hi, distances=True))  # type: ignore[misc]
                self._with_distances += np.array([more - scan, rows])
        self._keys.append(probe.keys)

    def _time(self, query: Callable[[], object]) -> float:
        """Median time of a query, microseconds: after an untimed run, or each with empty caches."""
        if self._before is None:
            query()
        times = []
        for _ in range(self._repeats):
            if self._before is not None:
                self._before()
            start = time.perf_counter_ns()
            query()
            times.append(time.perf_counter_ns() - start)
        return statistics.median(times) / 1000

    def fit(self, rows_per_block: float) -> CostModel:
        """Fit the cost model to all timings by least squares."""
        if not self._scans:  # every statement had more than `TOO_MANY_ROWS`
            return CostModel.of_equal_parts()
        (statement, descent, scanned), s_scan = _least_squares(self._scans)
        (_, _, counted), s_count = _least_squares(self._counts)
        counted = min(counted, scanned)
        # A row's cost to the client is the cost of scanning it minus that of counting it.
        row = scanned - counted
        more_time, rows = self._with_distances.tolist()
        model = CostModel(
            statement=statement,
            descent=descent,
            block=counted * rows_per_block,
            row=row,
            rows_per_block=rows_per_block,
            distances=_times_dearer(more_time, rows, counted + row),
            spread={
                "statement": s_scan[0],
                "descent": s_scan[1],
                "row": s_scan[2],
                "block": s_count[2],
            },
        )
        return _cautious(model, self._keys, self._quantiles, self._store.count)


def _cautious(
    model: CostModel,
    frames: Sequence[Keys],
    quantiles: QuantileVector,
    count: Callable[[Keys, Keys], int],
) -> CostModel:
    """The model with the caution of least cost over frames, given by their row keys (U,)."""
    trials = []
    for caution in CAUTIONS:
        cautious = replace(model, caution=caution)
        ranges = rows = 0
        for keys in frames:
            lows, highs = cbgroup(keys, keys, quantiles, cautious)
            ranges += len(lows)
            rows += count(lows, highs)
        # of equal costs, the greater caution: it reads fewer rows
        trials.append((model.descent * ranges + model.row_scanned * rows, -caution))
    return replace(model, caution=-min(trials)[1])


def _times_dearer(more_time: float, rows: float, row_scanned: float) -> float:
    """Ratio of the costs of rows with and without `more_time`; 1 without measured rows."""
    if more_time <= 0.0 or rows <= 0.0 or row_scanned <= 0.0:
        return 1.0
    return 1.0 + more_time / (rows * row_scanned)


def _least_squares(
    measured: Sequence[tuple[float, ...]],
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Fit times (last column) to the columns before it; figures >= 0 and relative errors.

    Weighted by 1 / time, for the least relative errors.
    """
    table = np.array(measured, dtype=np.float64)
    design, times = table[:, :-1], table[:, -1]
    weights = 1 / times
    weighted = design * weights[:, None]
    figures, residual = _non_negative(weighted, np.ones(len(times)))
    freedom = max(len(times) - design.shape[1], 1)
    covariance = np.linalg.pinv(weighted.T @ weighted) * residual**2 / freedom
    errors = np.sqrt(np.diag(covariance)) / np.where(figures > 0, figures, np.inf)
    return tuple(map(float, figures)), tuple(map(float, errors))


def _non_negative(design: Floats, wanted: Floats) -> tuple[Floats, float]:
    """Figures >= 0 of the best fit, and the length of its residual.

    The best fit over all subsets of columns without a figure below 0. ``scipy.optimize`` takes as
    long to load as all timings.
    """
    best, least = np.zeros(design.shape[1]), float(np.linalg.norm(wanted))
    for chosen in product((False, True), repeat=design.shape[1]):
        figures = np.zeros(design.shape[1])
        figures[list(chosen)] = np.linalg.lstsq(design[:, chosen], wanted, rcond=None)[0]
        residual = float(np.linalg.norm(design @ figures - wanted))
        if figures.min() >= 0.0 and residual < least:
            best, least = figures, residual
    return best, least


def _probes(store: Store, quantiles: QuantileVector) -> list[_Probe]:
    """Spheres of shell points on occupied voxels, small and large ones in turn."""
    rng = np.random.default_rng(0)
    grid = store.grid
    shift = row_shift(store.layout)
    places = rng.choice(quantiles.bounds, size=64)
    centers = grid.centers(grid.decode(places << shift))
    record = grid.for_kernels(shift)
    probes = []
    for n, surface in enumerate(centers):
        n_points = (300, 100, 30, 600)[n % 4]
        radius = min(grid.voxel_size * (12, 8, 4, 24)[n % 4], grid.edge / 4)
        pose = np.eye(4)
        # A tool lies on a surface or just below it; farther inside, gaps would hold more rows.
        away = rng.normal(size=3)
        pose[:3, 3] = surface + away / np.linalg.norm(away) * radius * rng.uniform(0.5, 1.0)
        _, addresses, keys = locate(PointShell.sphere(radius, n_points), pose, record)
        if not len(keys):
            continue
        first, last = shell_keys.spans_of_keys(addresses, keys, record)
        probes.append(_Probe(keys, first, last))
    return probes
