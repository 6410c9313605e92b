"""The measures: what each one is called, what is wanted of the distance law, and the page's tables.

docs/feel.md says how each is taken.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from page_tables import NONE, table

Cell = Mapping[str, Any]
LAWS = ("plane", "distance")
"""Columns of the table: the laws, as `touch` names them."""


@dataclass(frozen=True)
class Measure:
    """One line of the table.

    title : what is measured, with the cases that its values stand for; wanted : in words; limits :
    of each value, or one for all of them; none where nothing is demanded; unit : after the values;
    percent : whether values are shares, shown as percentages.
    """

    title: str
    wanted: str = NONE
    limits: Sequence[float] = ()
    unit: str = "N"
    percent: bool = False

    def missed(self, cell: Cell) -> bool:
        """Whether a cell has a value beyond its limit."""
        values = cell["values"]
        limits = list(self.limits) * (len(values) if len(self.limits) == 1 else 1)
        pairs = list(zip(values, limits, strict=True)) if limits else []
        return not all(value <= limit for value, limit in pairs)

    def text(self, cell: Cell | None) -> str:
        """Values of a cell with their unit, in bold where they miss what is wanted."""
        if cell is None or not cell["values"]:
            return NONE
        factor, unit = (100.0, "%") if self.percent else (1.0, self.unit)
        numbers = " / ".join(number_text(factor * value) for value in cell["values"])
        said = f"{numbers} {unit}".strip()
        if cell.get("without_force"):
            said += f"; no force in {cell['without_force']:,} of {cell['slides']:,}"
        return f"**{said}**" if self.missed(cell) else said


def number_text(value: float) -> str:
    """A number with three digits at most."""
    if not math.isfinite(value):
        return "none"
    if abs(value) < 1e-6:
        return "0" if value == 0.0 else f"{value:.0e}"
    if abs(value) >= 99.5:
        return f"{value:,.0f}"
    return f"{value:.2g}" if abs(value) < 9.95 else f"{value:.3g}"


MEASURES: Mapping[str, Measure] = {
    "touch_ripple": Measure(
        "`touch`: ripple on planes, 9 / 100 / 289 points",
        "<= 2 / 1 / 1 %",
        (0.02, 0.01, 0.01),
        percent=True,
    ),
    "touch_step": Measure(
        "`touch`: largest step within 0.1 mm, planes, to 0.5 / 0.8 voxels deep",
        "<= 0.05 N",
        (0.05,),
    ),
    "session_ripple": Measure(
        "session: ripple at 0.5 / 2 / 10 mm", "<= 2 / 1 / 0.2 %", (0.02, 0.01, 0.002), percent=True
    ),
    "session_force": Measure(
        "session: error of the force at 2 / 5 / 10 mm", "<= 1 %", (0.01,), percent=True
    ),
    "session_edge_step": Measure(
        "session: largest step round a convex edge, 0.4 / 0.8 voxels deep",
        "<= 0.05 N up to half a voxel",
        (0.05, math.inf),
    ),
    "session_edge_side": Measure(
        "session: side force round a convex edge, 0.4 / 0.8 voxels deep",
        "<= 20 % up to half a voxel",
        (0.20, math.inf),
        percent=True,
    ),
    "session_enter": Measure(
        "session: largest step a millisecond, entering at 10 mm/s", "<= 0.05 N", (0.05,)
    ),
    "tap": Measure("tap at 0.3 m/s, firm grip: overshoot", "<= 25 %", (0.25,), percent=True),
    "period": Measure(
        "computing a period, 289 points in contact, p50 / p99",
        "<= 40 / 100 us",
        (40.0, 100.0),
        unit="us",
    ),
    "walk": Measure("walk over a model: largest step a millisecond / force above 30 Hz"),
}
"""The measures by the name of their cells, in the order of the table."""


def table_of(cells: Sequence[Cell]) -> str:
    """The table: measure, the plane law's direct frame, the distance law, what is wanted."""
    found = {(cell["measure"], cell["law"]): cell for cell in cells}
    rows = [
        [one.title, *(one.text(found.get((key, law))) for law in LAWS), one.wanted]
        for key, one in MEASURES.items()
        if any(measure == key for measure, _ in found)
    ]
    return table(["measure", "plane, direct", "distance, coupled", "wanted"], rows)


def walls_of(cells: Sequence[Cell]) -> str:
    """The stiffest walls of the distance law, N/m: a line for each grip and rate, by the delay."""
    (found,) = [cell for cell in cells if cell["measure"] == "z_width"]
    rows: dict[tuple[str, float], list[str]] = {}
    for case in found["cases"]:
        row = rows.setdefault((case["grip"], case["rate"]), [])
        row.append(number_text(case["stiffness"]))
    delays = sorted({1e3 * case["delay"] for case in found["cases"]})
    head = ["grip, rate", *(f"delay {delay:g} ms" for delay in delays)]
    return table(head, [[f"{g}, {rate:,.0f} Hz", *row] for (g, rate), row in rows.items()])
