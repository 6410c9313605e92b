"""The quantile vector and the cost model (the paper, section 5), fitted to the opened database."""

import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels import contact
from hapticdb.kernels.grouping import gap_rows, group_by_gap
from hapticdb.store.base import Frame, Keys, Store, SupportsStatement, row_shift

DEFAULT_RESOLUTION = 10_000
"""Buckets of the quantile vector: the paper's best."""
MAX_RESOLUTION = 1_000_000
SMALL_GAP = 1 << 13
"""Voxel keys; among the gaps that a frame's shell leaves, those of up to sixteen bricks."""


@dataclass(frozen=True)
class QuantileVector:
    """Equi-count histogram of the row keys (the paper's Definition 2).

    Attributes
    ----------
    bounds : (R + 1,) int64
        Ascending; bound i is the key of the row of rank ceil(i N / R), bound 0 the lowest key.
    n_rows : int
        N, rows of the index table.
    source : str
        Where the bounds come from: ``computed``, ``kept`` since the last write, or the engine's own
        ``server statistics``.
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
        """Rows that each bucket stands for."""
        return self.n_rows / self.resolution

    def rows_between(self, left: int, right: int) -> float:
        """Expected rows with a key in [left, right]; of neighbouring ranges they add."""
        return float(gap_rows(left, right, self.bounds, self.rows_per_bucket))

    @classmethod
    def of(cls, store: Store, resolution: int = DEFAULT_RESOLUTION) -> "QuantileVector":
        """Quantile vector of all rows of an environment."""
        if not 1 <= resolution <= MAX_RESOLUTION:
            raise UsageError(f"{resolution} quantiles: give 1 to {MAX_RESOLUTION}")
        return cls(*store.quantiles(resolution))


@dataclass(frozen=True)
class CostModel:
    """What the parts of a query cost on one engine and machine, microseconds.

    A frame of R ranges that reads S rows costs ``statement + descent R + row_scanned S``, with
    ``row_scanned = block / rows_per_block + row``: the paper's C(s) = C_io(s) + C_cpu(s), where
    C_io is the navigation (descent) plus the scan (leaf blocks), and C_cpu = k C_scan is what each
    row costs the client.

    Attributes
    ----------
    statement : float
        One statement of ranges, whatever it reads.
    descent : float
        One range more: a descent of the index and the start of a scan.
    block : float
        One leaf block scanned inside the engine.
    row : float
        One row handed to the client.
    rows_per_block : float
        Rows N over leaf blocks B.
    lookup, probe : float
        One statement of keys, and each key in it (strategy `array`).
    single : float
        One point query of the sequence (strategy `points`).
    aggregate, point : float
        The statement of Figure 3 with its second one, and each shell point in it.
    crowding, presence : float
        Rows found in the gaps of real frames, and under their keys, over those that the quantile
        vector expects there: rows crowd where a tool touches, which no histogram knows.
    spread : mapping
        Relative standard error of each fitted figure.
    """

    statement: float
    descent: float
    block: float
    row: float
    rows_per_block: float
    lookup: float
    probe: float
    single: float
    aggregate: float
    point: float
    crowding: float = 1.0
    presence: float = 1.0
    spread: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def row_scanned(self) -> float:
        """One row read in a range: its share of a leaf block, and its handling."""
        return self.block / self.rows_per_block + self.row

    @cached_property
    def row_in_gap(self) -> float:
        """One row that the quantile vector expects in a gap."""
        return self.row_scanned * self.crowding

    def of_ranges(self, n_ranges: int, rows: float) -> float:
        """Expected cost of one statement of ranges."""
        return self.statement + self.descent * n_ranges + self.row_scanned * rows

    def of_keys(self, n_keys: int, rows: float) -> float:
        """Expected cost of one statement of keys."""
        return self.lookup + self.probe * n_keys + self.row * rows

    def of_points(self, n_keys: int) -> float:
        """Expected cost of the point query sequence."""
        return self.single * n_keys

    def of_statement(self, n_points: int) -> float:
        """Expected cost of Figure 3."""
        return self.aggregate + self.point * n_points

    def cheapest(
        self, n_points: int, n_keys: int, n_ranges: int, rows_asked: float, rows_in_gaps: float
    ) -> Literal["array", "cbgroup", "points", "statement"]:
        """Strategy of the least expected cost for a frame of so many points, keys and ranges."""
        rows = rows_asked * self.presence
        array = self.of_keys(n_keys, rows)
        ranges = self.of_ranges(n_ranges, rows + rows_in_gaps * self.crowding)
        points = self.of_points(n_keys)
        statement = self.of_statement(n_points)
        least = min(array, ranges, points, statement)
        if array == least:
            return "array"
        if ranges == least:
            return "cbgroup"
        return "points" if points == least else "statement"

    def figures(self) -> dict[str, float]:
        """All figures by name, the spreads as ``name.spread``: what a store keeps."""
        plain = asdict(self)
        spread = plain.pop("spread")
        return plain | {f"{name}.spread": value for name, value in spread.items()}

    @classmethod
    def of_equal_parts(cls) -> "CostModel":
        """Figures for an empty environment, where nothing can be measured: all one."""
        return cls(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)

    @classmethod
    def from_figures(cls, figures: Mapping[str, float]) -> "CostModel":
        """Rebuild from `figures`."""
        spread = {k.removesuffix(".spread"): v for k, v in figures.items() if k.endswith(".spread")}
        plain = {k: v for k, v in figures.items() if not k.endswith(".spread")}
        return cls(**plain, spread=spread)


class _Probe(NamedTuple):
    """A located shell of the calibration: what `kernels.contact.locate` returned."""

    frame: Frame
    keys: Keys
    first: Keys
    last: Keys


def machine_name() -> str:
    """What the kept figures are filed under: they hold for one machine."""
    return f"{platform.node()} {platform.machine()}"


def calibrate(store: Store, *, seed: int = 0, repeats: int = 5, budget: float = 0.9) -> CostModel:
    """Measure what queries cost on this database, in real scans around its own surface.

    Spheres of shell points of several sizes are placed on occupied voxels drawn by the quantile
    vector, asked for in every form, and the medians of their times fitted by least squares with
    non-negative figures.

    Parameters
    ----------
    store : Store
        An environment with at least one row.
    seed : int
        Of the drawn places.
    repeats : int
        Timings of each form at each place; their median counts. The first, untimed, warms up.
    budget : float
        Seconds after which no further place is measured (at least 12 are).
    """
    size = store.size()
    if size.rows == 0:
        raise UsageError(f"{store.url} is empty: import a file before calibrating")
    rows_per_block = size.rows / max(size.leaf_blocks, 1)
    quantiles = QuantileVector.of(store)
    trials = _Trials(store, quantiles, repeats)
    started = time.perf_counter()
    for n, probe in enumerate(_probes(store, quantiles, seed)):
        trials.measure(probe)
        if n >= 11 and time.perf_counter() - started > budget:
            break
    return trials.fit(rows_per_block)


class _Trials:
    """Timings of every form at several places, and their fit."""

    def __init__(self, store: Store, quantiles: QuantileVector, repeats: int) -> None:
        self._store = store
        self._quantiles = quantiles
        self._repeats = repeats
        self._scans: list[tuple[float, ...]] = []
        self._counts: list[tuple[float, ...]] = []
        self._lookups: list[tuple[float, ...]] = []
        self._singles: list[tuple[float, ...]] = []
        self._statements: list[tuple[float, ...]] = []
        self._in_gaps = np.zeros(2)
        self._under_keys = np.zeros(2)

    def measure(self, probe: _Probe) -> None:
        """Ask for one shell in every form."""
        store = self._store
        for gap in (0, 1 << 9, 1 << 13, 1 << 16):
            lows, highs = group_by_gap(probe.keys, probe.first, probe.last, gap)
            rows = len(store.scan(lows, highs))
            if rows > 20_000:
                continue
            scan = self._time(lambda lo=lows, hi=highs: store.scan(lo, hi))  # type: ignore[misc]
            count = self._time(lambda lo=lows, hi=highs: store.count(lo, hi))  # type: ignore[misc]
            self._scans.append((1, len(lows), rows, scan))
            self._counts.append((1, len(lows), rows, count))
        self._compare(probe)
        rows = len(store.lookup(probe.keys))
        lookup = self._time(lambda: store.lookup(probe.keys))
        self._lookups.append((1, len(probe.keys), rows, lookup))
        few = probe.keys[:: max(1, len(probe.keys) // 20)].copy()
        self._singles.append((len(few), self._time(lambda: store.lookup_each(few))))
        if isinstance(store, SupportsStatement):
            self._statements.append(
                (1, len(probe.frame.addresses), self._time(self._figure_3(probe)))
            )

    def _compare(self, probe: _Probe) -> None:
        """Add up what is found in a frame's small gaps and under its keys, and what is expected."""
        keys = probe.keys
        lows, highs = group_by_gap(keys, probe.first, probe.last, SMALL_GAP)
        found = self._store.scan(lows, highs).keys
        is_asked = np.isin(found, keys)
        between = self._quantiles.rows_between
        asked = sum(between(key, key) for key in keys.tolist())
        scanned = sum(between(*ends) for ends in zip(lows.tolist(), highs.tolist(), strict=True))
        self._in_gaps += np.array([np.count_nonzero(~is_asked), scanned - asked])
        self._under_keys += np.array([np.count_nonzero(is_asked), asked])

    def _figure_3(self, probe: _Probe) -> Callable[[], object]:
        store = self._store
        assert isinstance(store, SupportsStatement)  # noqa: S101 - narrows the type for mypy

        def run() -> None:
            with self._store.snapshot():
                store.statement(probe.frame)
                store.statement_hits(probe.frame)

        return run

    def _time(self, query: Callable[[], object]) -> float:
        """Median time of a query, microseconds, after one that warms up."""
        query()
        times = []
        for _ in range(self._repeats):
            start = time.perf_counter_ns()
            query()
            times.append(time.perf_counter_ns() - start)
        return statistics.median(times) / 1000

    def fit(self, rows_per_block: float) -> CostModel:
        """Least squares over all that was measured."""
        if not self._scans:  # every range held more than a frame could wait for
            return CostModel.of_equal_parts()
        (statement, descent, scanned), s_scan = _least_squares(self._scans)
        (_, _, counted), s_count = _least_squares(self._counts)
        counted = min(counted, scanned)
        # the client's share of a row: what scanning it costs beyond counting it in the engine
        row = scanned - counted
        # keys and rows of a lookup go hand in hand: what rows cost is known from the scans
        keyed = [(*n, max(us - row * rows, us / 10)) for *n, rows, us in self._lookups]
        (lookup, probe), s_lookup = _least_squares(keyed)
        (single,), s_single = _least_squares(self._singles)
        (aggregate, point), s_statement = (
            _least_squares(self._statements) if self._statements else ((np.inf, np.inf), (0.0, 0.0))
        )
        return CostModel(
            statement=statement,
            descent=descent,
            block=counted * rows_per_block,
            row=row,
            rows_per_block=rows_per_block,
            lookup=lookup,
            probe=probe,
            single=single,
            aggregate=aggregate,
            point=point,
            crowding=_ratio(self._in_gaps),
            presence=_ratio(self._under_keys),
            spread={
                "statement": s_scan[0],
                "descent": s_scan[1],
                "row": s_scan[2],
                "block": s_count[2],
                "lookup": s_lookup[0],
                "probe": s_lookup[1],
                "single": s_single[0],
                "aggregate": s_statement[0],
                "point": s_statement[1],
            },
        )


def _ratio(found_and_expected: NDArray[np.float64]) -> float:
    """Rows found over rows expected; one where nothing can be said."""
    found, expected = found_and_expected.tolist()
    return float(found / expected) if found > 0 and expected > 0 else 1.0


def _least_squares(
    measured: Sequence[tuple[float, ...]],
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Fit times (last column) to the columns before it; figures >= 0 and relative errors.

    Rows are weighted by 1 / time: what counts is the relative error of a prediction.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 - half of the package's import time

    table = np.array(measured, dtype=np.float64)
    design, times = table[:, :-1], table[:, -1]
    weights = 1 / times
    weighted = design * weights[:, None]
    figures, residual = nnls(weighted, np.ones(len(times)))
    freedom = max(len(times) - design.shape[1], 1)
    covariance = np.linalg.pinv(weighted.T @ weighted) * residual**2 / freedom
    errors = np.sqrt(np.diag(covariance)) / np.where(figures > 0, figures, np.inf)
    return tuple(map(float, figures)), tuple(map(float, errors))


def _probes(store: Store, quantiles: QuantileVector, seed: int) -> list[_Probe]:
    """Spheres of shell points on occupied voxels, small and large ones in turn."""
    rng = np.random.default_rng(seed)
    grid = store.grid
    shift = row_shift(store.layout)
    places = rng.choice(quantiles.bounds, size=64)
    centers = grid.centers(grid.decode(places << shift))
    origin = np.array(grid.origin)
    grid_codes = (grid.bits, grid.curve_code)
    middle = np.zeros(3)
    middle.flags.writeable = False
    probes = []
    for n, center in enumerate(centers):
        n_points = (300, 100, 30, 600)[n % 4]
        radius = min(grid.voxel_size * (12, 8, 4, 24)[n % 4], grid.edge / 4)
        normals = -_fibonacci_sphere(n_points)
        points = -normals * radius
        # one compiled signature: PointShell, too, hands its arrays out read-only
        points.flags.writeable = normals.flags.writeable = False
        pose = np.eye(4)
        pose[:3, 3] = center
        placed, asked, keys = contact.locate(
            points, normals, middle, pose, origin, grid.voxel_size, *grid_codes, shift
        )
        if not len(keys):
            continue
        first, last = contact.spans_of_keys(asked, keys, *grid_codes, shift)
        frame = Frame(placed, asked[0], 1000.0, np.empty(0, dtype=np.int64))
        probes.append(_Probe(frame, keys, first, last))
    return probes


def _fibonacci_sphere(n_points: int) -> NDArray[np.float64]:
    """Points (N, 3) spread over the unit sphere along a spiral of the golden angle."""
    heights = 1 - (2 * np.arange(n_points) + 1) / n_points
    angles = np.pi * (1 + 5**0.5) * np.arange(n_points)
    radii = np.sqrt(1 - heights**2)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=1)
