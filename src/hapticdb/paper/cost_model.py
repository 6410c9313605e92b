"""Cost model of grouping (the paper, section 5)."""

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property

from hapticdb.store.base import Store


@dataclass(frozen=True)
class CostModel:
    """Costs of the parts of a query on one engine and machine, microseconds.

    A frame of R ranges that reads S rows costs ``statement + descent R + row_scanned S``, with
    ``row_scanned = block / rows_per_block + row``: the paper's C(s) = C_io(s) + C_cpu(s). There
    C_io is the navigation (descent) plus the scan (leaf blocks), and C_cpu = k C_scan the client's
    cost of the rows.

    statement : fixed cost of a statement of ranges
    descent : each range: a descent of the index and the start of a scan
    block : each leaf block scanned inside the engine
    row : each row passed to the client
    rows_per_block : rows N divided by leaf blocks B
    caution : factor on the expected rows of a gap in CBGroup's decision to close it, of least cost
        at the measured positions. Small gaps near a surface are empty or full, and seldom have the
        expected number of rows. A larger factor closes fewer gaps.
    distances : ratio of the costs of a range's rows with and without their distances. It counts
        rows of the index, so it includes the larger number of rows of distances. 1 without any.
    spread : relative standard error of each fitted figure
    """

    statement: float
    descent: float
    block: float
    row: float
    rows_per_block: float
    caution: float = 1.0
    distances: float = 1.0
    spread: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def row_scanned(self) -> float:
        """Cost of one row read in a range: its share of a leaf block and its cost to the client."""
        return self.block / self.rows_per_block + self.row

    @cached_property
    def row_in_gap(self) -> float:
        """Cost of an expected row of the quantile vector in a gap, multiplied by `caution`."""
        return self.row_scanned * self.caution

    @cached_property
    def with_distances(self) -> "CostModel":
        """The model of ranges whose rows are read with their distances."""
        if self.distances == 1.0:
            return self
        in_blocks = self.block / self.rows_per_block
        return replace(self, row=self.row_scanned * self.distances - in_blocks, distances=1.0)

    def figures(self) -> dict[str, float]:
        """All figures by name, the spreads as ``name.spread``, in the form of a store."""
        plain = asdict(self)
        spread = plain.pop("spread")
        return plain | {f"{name}.spread": value for name, value in spread.items()}

    @classmethod
    def of_equal_parts(cls) -> "CostModel":
        """Model with all figures 1, for an environment without rows to measure."""
        return cls(1.0, 1.0, 1.0, 1.0, 1.0)

    @classmethod
    def from_figures(cls, figures: Mapping[str, float]) -> "CostModel":
        """Rebuild from `figures`."""
        plain = {name: value for name, value in figures.items() if "." not in name}
        spread = {n: figures[f"{n}.spread"] for n in plain if f"{n}.spread" in figures}
        return cls(**plain, spread=spread)

    @classmethod
    def stored(cls, store: Store, machine: str) -> "CostModel | None":
        """Model of the stored figures of a machine; None without any that make a model."""
        figures = store.costs(machine) or {}
        names = {name for name in figures if "." not in name}
        expected = {each.name for each in fields(cls)} - {"spread"}
        if names != expected or figures["rows_per_block"] <= 0.0 or min(figures.values()) < 0.0:
            return None  # damage alters costs, never answers: measured anew
        return cls.from_figures(figures)


def machine_name() -> str:
    """Name of this machine, the key of its figures in a store."""
    return f"{platform.node()} {platform.machine()}"
