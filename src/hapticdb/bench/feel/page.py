"""The page of `hapticdb bench --feel`: the table, what each measure is, and the plots."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hapticdb.bench.feel.measures import MEASURES, Measure, number_text
from hapticdb.bench.feel.plots import PLOTS, WALK_PICTURE
from hapticdb.bench.markdown import (
    NONE,
    bullets,
    fact_table,
    image,
    notes_of,
    paragraphs,
    table,
    versions_of,
    write_page,
)

LAWS = ("plane", "smooth")
"""Columns of the table: the laws, as `touch` and sessions name them."""
TITLE = "How good the forces feel"
OPENING = """\
Written by `hapticdb bench --feel` (in a clone: `make feel`) from `feel.json`. Both laws are
measured in one run, on the same scenes:

- **plane**: the tangent plane (McNeely, Puterbaugh and Troy 1999) rendered directly,
  without a coupling, as `--law plane` does;
- **smooth**: the distance law with the quasi-static coupling.

The scenes are closed forms as triangles. They go the way of a user's files: written as a mesh,
imported, stored, fetched into cells. No surface is aligned to the grid by chance: places and most
orientations are drawn at random, with a fixed seed. Sessions run in one process on a counted clock,
so nothing but the row of computing time depends on the machine."""
READING = """\
A value in **bold** misses what is wanted. Depths count from where contact begins: the surface
itself for the plane law, and 1.5 voxels before it for the smooth law, unless the shell is drawn
inward. For `touch` the plane law gets solid scenes (sheets every 0.45 voxels), because a point that
has left the one layer of voxels of a single sheet feels nothing."""
PERSON = """\
Where a person is simulated, hand and device are one mass, held by a spring and a damper at a point
that moves as the arm wants. This is linear, so each period is stepped exactly. A force is sent at
the start of a period, acts after the delay, and is held for one period."""


def write_feel_page(result: Mapping[str, Any], path: Path, plots: str) -> None:
    """Write the page of a result; plots: its plots' folder, as a link from the page."""
    drawn = [plot for plot in PLOTS if any(c["curve"] == plot.curve for c in result["curves"])]
    pictures = [image(plot.title, f"{plots}/{plot.name}.svg") for plot in drawn]
    conditions = dict(result["machine"]) | versions_of(result) | dict(result["inputs"])
    write_page(
        path,
        [
            f"# {TITLE}",
            OPENING,
            "## Both laws",
            table_of(result["cells"]),
            READING,
            "## What is measured",
            bullets(f"**{plain_title(m, result['cells'])}**. {m.how}" for m in MEASURES),
            PERSON,
            "## The stiffest wall",
            walls_of(result["cells"]),
            "## Plots",
            paragraphs(*pictures, image("The walk over the model", f"{plots}/{WALK_PICTURE}")),
            "## Conditions",
            fact_table(conditions),
            bullets(notes_of(result)),
        ],
    )


def cell_of(cells: Sequence[Mapping[str, Any]], key: str, law: str) -> Mapping[str, Any] | None:
    """The cell of a measure and a law, if it was measured."""
    return next((c for c in cells if c["measure"] == key and c["law"] == law), None)


def plain_title(measure: Measure, cells: Sequence[Mapping[str, Any]]) -> str:
    """Title of a measure, with the cases of this result where they are not always the same."""
    if "{cases}" not in measure.title:
        return measure.title
    found = [c for c in cells if c["measure"] == measure.key]
    return measure.title.format(cases=cases_of(found[0]) if found else "no case")


def cases_of(cell: Mapping[str, Any]) -> str:
    """Grips, rates and delays of the stiffest walls in words."""
    grips = dict.fromkeys(str(case["grip"]) for case in cell["cases"])
    rates = dict.fromkeys(f"{case['rate'] / 1e3:g} kHz" for case in cell["cases"])
    delays = dict.fromkeys(f"{case['delay'] * 1e3:g}" for case in cell["cases"])
    return f"{', then '.join(grips)}: {', then '.join(rates)}, {' / '.join(delays)} ms of delay"


def marked(measure: Measure, cell: Mapping[str, Any] | None) -> str:
    """Values of a cell, in bold where they miss what is wanted."""
    text = measure.text(cell)
    return f"**{text}**" if cell is not None and measure.missed(cell) else text


def rows_of(cells: Sequence[Mapping[str, Any]]) -> list[tuple[Measure, list[str]]]:
    """Each measured line: the measure, then title, values of each law, what is wanted."""
    found = []
    for measure in MEASURES:
        own = [cell_of(cells, measure.key, law) for law in LAWS]
        if any(own):
            texts = [marked(measure, cell) for cell in own]
            found.append((measure, [plain_title(measure, cells), *texts, measure.wanted or NONE]))
    return found


def table_of(cells: Sequence[Mapping[str, Any]]) -> str:
    """The table: measure, plane, smooth, wanted."""
    return table(["measure", *LAWS, "wanted"], [row for _, row in rows_of(cells)])


def missed_lines(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each value of the smooth law that misses what is wanted."""
    lines = []
    for measure in MEASURES:
        cell = cell_of(cells, measure.key, "smooth")
        if cell is not None and measure.missed(cell):
            title = plain_title(measure, cells)
            lines.append(f"missed: {title}: {measure.text(cell)}, wanted {measure.wanted}")
    return lines


def walls_of(cells: Sequence[Mapping[str, Any]]) -> str:
    """Table of the stiffest walls: a line for each grip, rate and delay."""
    by_law = {law: cell_of(cells, "z_width", law) for law in LAWS}
    first = next((cell for cell in by_law.values() if cell), None)
    if first is None:
        return ""
    rows = []
    for n, case in enumerate(first["cases"]):
        values = [
            NONE if cell is None else number_text(cell["values"][n]) for cell in by_law.values()
        ]
        delay = f"{case['delay'] * 1e3:g}"
        rows.append([str(case["grip"]), f"{case['rate']:,.0f}", delay, *values])
    head = ["grip", "rate, Hz", "delay, ms", *(f"{law}, N/m" for law in LAWS)]
    return table(head, rows)
