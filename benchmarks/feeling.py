"""How good the forces feel: the measures of docs/feel.md, on closed forms and on a model.

    make feel                          # results/feel.json, results/feel.svg, docs/feel.md
    make feel ARGS=--quick             # results-quick/, a first look

The walk is over the vintage car in the folder that HAPTICDB_TEST_DATA names; over the sample car
where there is none.
"""

import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import hapticdb
import page_tables
import records
from awake import awake
from feel import sliding, stability, touching, walking
from feel.ground import N_RANDOM
from feel.measures import table_of
from feel.stability import DEVICE_DAMPING, DEVICE_KG, FIRM, LIGHT
from hapticdb import GridOptions, ImportOptions
from hapticdb.sample import write_sample

CAR = "demo_vintage_car/vintage_car.glb"
EXTENT = 1.6
"""Edge of the model's grid as a multiple of its longest side."""
Record = dict[str, Any]


@dataclass(frozen=True)
class Effort:
    """How much is measured. Larger numbers find the worst case more surely and take longer.

    n_random : planes turned at random; tries : halvings of the range of stiffness; rates, delays :
    of the stiffest wall, Hz and s; periods : that are timed; places : of the walk; bits : of the
    model's grid.
    """

    n_random: int = N_RANDOM
    tries: int = stability.TRIES
    rates: Sequence[float] = stability.RATES
    delays: Sequence[float] = stability.DELAYS
    periods: int = 20_000
    places: int = walking.PLACES
    bits: int = 11


QUICK = Effort(2, 5, (1000.0,), (0.0, 0.002), 2000, 200, 9)
PANELS = (
    ("depth", "plane", "touch against depth, plane", "depth, voxels"),
    ("depth", "distance", "touch against depth, distance", "depth, voxels"),
    ("slide", "plane", "touch on a slide, plane", "way, mm"),
    ("slide", "distance", "touch on a slide, distance", "way, mm"),
    ("press", "distance", "session against the hand's depth", "depth, m"),
    ("edge", "distance", "session round a convex edge", "way, m"),
    ("tap", "distance", "a tap at 0.3 m/s, firm grip", "time, s"),
    ("walk", "distance", "a walk over a model", "time, s"),
)
"""Panels of the plot: curve, law, title, name of the x axis."""


def measure(effort: Effort, place: Path, model: Path) -> tuple[list[Record], list[Record]]:
    """All measures: cells by measure and law, and curves for the plot."""
    started = time.perf_counter()
    cells: list[Record] = []
    curves: list[Record] = []

    def say(line: str) -> None:
        print(f"{time.perf_counter() - started:6.0f} s  {line}", file=sys.stderr, flush=True)

    def keep(law: str, **found: Record) -> None:
        cells.extend({"measure": key, "law": law} | cell for key, cell in found.items())

    def draw(curve: str, law: str, drawn: Sequence[Record]) -> None:
        curves.extend({"curve": curve, "law": law} | each for each in drawn)

    for law in (touching.PLANE, touching.DISTANCE):
        say(f"touch, {law.name} law")
        slides = touching.slides_of_touch(law, place, effort.n_random)
        draw("slide", law.name, [slides.pop("curve")])
        draw("depth", law.name, touching.depth_curves(law, place))
        keep(law.name, **slides)
    say("sessions on planes")
    keep("distance", **sliding.on_planes(place, effort.n_random))
    force, pressed = sliding.force_of_sessions(place)
    draw("press", "distance", pressed)
    keep("distance", session_force=force)
    say("sessions round an edge")
    edges, rounded = sliding.edge_of_sessions(place)
    draw("edge", "distance", rounded)
    keep("distance", **edges)
    say("taps and stiff walls")
    tap, tapped = stability.tap(place)
    draw("tap", "distance", [tapped])
    walls = stability.z_width(place, effort.rates, effort.delays, effort.tries)
    keep("distance", tap=tap, z_width=walls)
    say("computing time")
    keep("distance", period=sliding.time_of_periods(place, effort.periods))
    say("a walk over a model")
    url = place / "model.db"
    grid = GridOptions(bits=effort.bits, extent=EXTENT)
    (report,) = hapticdb.import_files(url, [model], ImportOptions(grid=grid))
    if report.error is not None:
        raise report.error
    walk, walked = walking.walk_over(url, effort.places)
    draw("walk", "distance", [walked])
    keep("distance", walk=walk)
    return cells, curves


def plot(curves: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw all panels into one SVG."""
    with rc_context({"svg.hashsalt": "hapticdb", "svg.fonttype": "none", "font.size": 7}):
        figure = Figure(figsize=(13.0, 5.6), layout="constrained")
        FigureCanvasAgg(figure)
        figure.subplots(2, 4)
        for axes, (name, law, title, x) in zip(figure.axes, PANELS, strict=True):
            own = [c for c in curves if (c["curve"], c["law"]) == (name, law)]
            for curve in own:
                axes.plot(curve["x"], curve["y"], linewidth=0.8, label=curve["label"])
            axes.set(title=title, xlabel=x, ylabel="force, N")
            axes.grid(visible=True, linewidth=0.3)
            if len(own) > 1:
                axes.legend(fontsize=6)
        figure.savefig(path, metadata={"Date": None})


def inputs_of(effort: Effort, model: Path) -> dict[str, str]:
    """What was measured on, in words."""
    grips = "; ".join(
        f"{grip.name}: {grip.stiffness:g} N/m, {grip.damping:.3g} N s/m" for grip in (LIGHT, FIRM)
    )
    return {
        "scenes": "closed forms as triangles, imported, their cells in memory",
        "person": f"{DEVICE_KG:g} kg and {DEVICE_DAMPING:g} N s/m of the device; {grips}",
        "planes": f"0, 5, 20 and 45 degrees, {effort.n_random} turned at random",
        "walk": f"{model.name}, {effort.bits} bits",
    }


def main() -> None:
    """Measure, write JSON and plot, and fill the page's tables."""
    is_quick, out = records.asked(__doc__, "fewer cases, for a first look")
    effort = QUICK if is_quick else Effort()
    with awake(), tempfile.TemporaryDirectory(prefix="hapticdb-feel-") as folder:
        model = records.data(CAR) or write_sample(Path(folder)).car
        scenes = Path(folder, "scenes")
        scenes.mkdir()
        cells, curves = measure(effort, scenes, model)
    found = records.result("feel", cells, inputs_of(effort, model)) | {"curves": curves}
    records.write(out, {"feel": found})
    plot(curves, out / "feel.svg")
    page_tables.refill("docs/feel.md", out, out / "feel.md" if is_quick else None)
    print(table_of(cells))


if __name__ == "__main__":
    main()
