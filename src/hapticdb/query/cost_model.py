"""The cost model of grouping: what the parts of a query cost (the paper, section 5)."""

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property


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
        Rows found in the gaps that grouping closes, and under a frame's keys, over those that the
        quantile vector expects there: rows crowd where a tool touches, which no histogram knows.
    caution : float
        How many times its expected rows a gap counts when it is decided, so that real frames cost
        least: the small gaps near a surface are empty or full, and seldom as expected.
    group, group_key : float
        Grouping by cost itself: a frame, and each key in it.
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
    caution: float = 1.0
    group: float = 0.0
    group_key: float = 0.0
    spread: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def row_scanned(self) -> float:
        """One row read in a range: its share of a leaf block, and its handling."""
        return self.block / self.rows_per_block + self.row

    @cached_property
    def row_in_gap(self) -> float:
        """One row that the quantile vector expects in a gap, as deciding on that gap counts it."""
        return self.row_scanned * self.caution

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

    def of_grouping(self, n_keys: int) -> float:
        """Expected cost of grouping by cost itself."""
        return self.group + self.group_key * n_keys

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


def machine_name() -> str:
    """What the kept figures are filed under: they hold for one machine."""
    return f"{platform.node()} {platform.machine()}"
