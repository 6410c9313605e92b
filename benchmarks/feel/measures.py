"""The measures: what each one is called, what is wanted of the smooth law, and the page's tables.

docs/feel.md says how each is taken.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from page_tables import NONE, listed, table

Cell = Mapping[str, Any]
LAWS = ("plane", "smooth")
"""Columns of the table: the laws, as `touch` names them."""


@dataclass(frozen=True)
class Measure:
    """One line of the table.

    title : what is measured, with the cases that its values stand for; wanted : in words; limits :
    of each value, or one for all of them; none where nothing is demanded; unit : after the values;
    percent : whether values are shares, shown as percentages; is_floor : whether limits are least
    values.
    """

    title: str
    wanted: str = NONE
    limits: Sequence[float] = ()
    unit: str = "N"
    percent: bool = False
    is_floor: bool = False

    def missed(self, cell: Cell) -> bool:
        """Whether a cell has a value beyond its limit."""
        values = cell["values"]
        limits = list(self.limits) * (len(values) if len(self.limits) == 1 else 1)
        pairs = list(zip(values, limits, strict=True)) if limits else []
        if self.is_floor:
            return not all(value >= limit for value, limit in pairs)
        return not all(value <= limit for value, limit in pairs)

    def text(self, cell: Cell | None) -> str:
        """Values of a cell with their unit, in bold where they miss what is wanted."""
        if cell is None or not cell["values"]:
            return NONE
        factor, unit = (100.0, "%") if self.percent else (1.0, self.unit)
        numbers = " / ".join(number_text(factor * value) for value in cell["values"])
        said = f"{numbers} {unit}".strip()
        if cell.get("unfelt"):
            said += f"; nothing felt in {cell['unfelt']:,} of {cell['slides']:,}"
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
    "session_scale": Measure(
        "session: difference at scale 0.1 to 100", "<= 1e-4 %", (1e-6,), percent=True
    ),
    "session_lift": Measure(
        "session: least normal force at lift-off, 0.2 m/s", ">= 0 N", (0.0,), is_floor=True
    ),
    "session_enter": Measure(
        "session: largest step a millisecond, entering at 10 mm/s", "<= 0.05 N", (0.05,)
    ),
    "session_energy": Measure(
        "session: energy of a press and release, share of its bound", "<= 1", (1.0,), unit=""
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
    """The table: measure, the plane law's direct frame, the smooth law, what is wanted."""
    found = {(cell["measure"], cell["law"]): cell for cell in cells}
    rows = [
        [one.title, *(one.text(found.get((key, law))) for law in LAWS), one.wanted]
        for key, one in MEASURES.items()
    ]
    return table(["measure", "plane, direct", "smooth", "wanted"], rows)


def walls_of(cells: Sequence[Cell]) -> str:
    """The stiffest walls of the smooth law: a line for each grip, rate and delay."""
    (found,) = [cell for cell in cells if cell["measure"] == "z_width"]
    return listed(
        found["cases"],
        {
            "grip": lambda case: case["grip"],
            "rate, Hz": lambda case: f"{case['rate']:,.0f}",
            "delay, ms": lambda case: f"{1e3 * case['delay']:g}",
            "stiffest wall, N/m": lambda case: number_text(case["stiffness"]),
        },
    )
