"""The paper's Figures 8, 9 and 10 as plots."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticdb.bench.cells import (
    IN_THE_SERVER,
    ONE_STATEMENT,
    Cell,
    distinct,
    form_of,
    frame_us,
    grouped,
    is_cut_short,
    named,
    number,
    with_strategy,
)
from hapticdb.bench.contests import contests
from hapticdb.bench.drawing.canvas import (
    BLUE,
    ENGINE_COLORS,
    FAINT,
    GREEN,
    INK,
    MARKERS,
    ORANGE,
    PURPLE,
    RED,
    RULE,
    STRATEGY_COLORS,
    Stroke,
    count,
    entry,
    fix_ticks,
    head,
    lay_out,
    log_axis,
)
from hapticdb.bench.drawing.panels import (
    TYPICAL,
    Panel,
    along,
    by_layout_and_engine,
    framing_of,
    label_outer_y,
    level,
    line,
    share_times,
    times,
)
from hapticdb.bench.drawing.plots import Plot

Place = Callable[[float], float]
STROKES: dict[str, Stroke] = {ONE_STATEMENT: "-", IN_THE_SERVER: "--"}
REGIONS = {"low": (ORANGE, "o"), "middle": (BLUE, "s"), "high": (PURPLE, "D")}
COUNTED = {
    "ranges": ("ranges", BLUE, "s"),
    "rows": ("rows read", GREEN, "D"),
    "false_rows": ("rows read that no point asked for", RED, "o"),
}
WITH_RATIO = (
    f"{TYPICAL} Above each panel: CBGroup's as a multiple of the best MAXGAP's, in one statement"
)


def draw_figure8(plot: Plot) -> Figure:
    """Time a frame and the grouping's own against the resolution: a panel a layout."""
    layouts = distinct(plot.cells, "layout") or [None]
    engines = distinct(plot.cells, "engine") or [None]
    looks = dict(zip(engines, zip(ENGINE_COLORS * 9, MARKERS * 9, strict=True), strict=False))
    legend: list[Artist] = [
        entry(str(engine or "time a frame"), color, line="-", marker=marker)
        for engine, (color, marker) in looks.items()
    ]
    legend.append(entry("grouping alone", FAINT, line="--"))
    framing = framing_of(plot, legend, [TYPICAL], height=2.8)
    canvas = lay_out(framing, 1, len(layouts))
    grouping = [v for cell in plot.cells if (v := number(cell, "grouping_us"))]
    for column, (axes, layout) in enumerate(zip(canvas.panels[0], layouts, strict=True)):
        head(axes, named(layout or ""))
        for engine, (color, marker) in looks.items():
            own = [
                cell
                for cell in plot.cells
                if cell.get("layout") == layout and cell.get("engine") == engine
            ]
            line(axes, along(own, "resolution"), color, marker=marker)
            alone = sorted(
                (x, y)
                for cell in own
                if (x := number(cell, "resolution")) and (y := number(cell, "grouping_us"))
            )
            axes.plot([x for x, _ in alone], [y for _, y in alone], "--", color=color)
        log_axis(axes, "x", [float(n) for n in distinct(plot.cells, "resolution") if n > 0])
        axes.set_xlabel("resolution of the quantile vector, buckets")
        log_axis(axes, "y", times(plot.cells) + grouping, unit="us")
        if column == 0:
            axes.set_ylabel("time a frame")
        else:
            axes.tick_params(axis="y", labelleft=False)
    return canvas.figure


# --- Figures 9 and 10 ---------------------------------------------------------------------------


def gap_places(cells: Iterable[Cell]) -> tuple[Place, list[float], list[str]]:
    """Where each MAXGAP stands: by its logarithm, 0 a step before; ticks, their names."""
    gaps = sorted({gap for cell in cells if (gap := number(cell, "maxgap")) is not None})
    positive = [gap for gap in gaps if gap > 0]
    first = math.floor(math.log10(min(positive, default=1.0)))
    last = math.ceil(math.log10(max(positive, default=1.0)))
    powers = range(first, last + 1)

    def place(gap: float) -> float:
        return math.log10(gap) if gap > 0 else first - 1.0

    ticks = [float(n) for n in powers]
    names = [count(10.0**n) for n in powers]
    return (place, [first - 1.0, *ticks], ["0", *names])


def _gap_axis(panel: Panel, places: tuple[Place, list[float], list[str]]) -> None:
    _, ticks, names = places
    axes = panel.axes
    axes.set_xlim(ticks[0] - 0.35, ticks[-1] + 0.35)
    fix_ticks(axes.xaxis, ticks, names)
    axes.grid(visible=True, axis="x", color=RULE, linewidth=0.7)
    if panel.is_lowest:
        axes.set_xlabel("MAXGAP, voxel keys")


def _curve(cells: Sequence[Cell], place: Place, form: str) -> list[tuple[float, float, bool]]:
    found = along(with_strategy(cells, "maxgap", form), "maxgap")
    return [(place(x), y, hollow) for x, y, hollow in found]


def draw_figure9(plot: Plot) -> Figure:
    """MaxGap's curve and CBGroup's line, in both forms, for each layout and engine."""
    maxgap, cbgroup = STRATEGY_COLORS["maxgap"], STRATEGY_COLORS["cbgroup"]
    legend: list[Artist] = [
        entry("MaxGap", maxgap, line="-", marker="D"),
        entry("CBGroup", cbgroup, line="-"),
        entry("array: all keys, no ranges", STRATEGY_COLORS["array"], line=":", width=1.1),
    ]
    if any(form_of(cell) == IN_THE_SERVER for cell in plot.cells):
        legend.append(entry("dashed: a loop in the server", FAINT, line="--"))
    framing = framing_of(plot, legend, [f"{WITH_RATIO}."])
    canvas, panels = by_layout_and_engine(plot, framing)
    places = gap_places(plot.cells)
    for panel in panels:
        for form, stroke in STROKES.items():
            curve = _curve(panel.cells, places[0], form)
            line(panel.axes, curve, maxgap, stroke=stroke, marker="D", size=3.8)
            _levels(panel.axes, with_strategy(panel.cells, "cbgroup", form), cbgroup, stroke)
        for cell in with_strategy(panel.cells, "array"):
            level(
                panel.axes, frame_us(cell) or 0.0, STRATEGY_COLORS["array"], stroke=":", width=1.1
            )
        _gap_axis(panel, places)
        _tell_ratio(panel)
    share_times(panels, "y", times(plot.cells), "time a frame")
    return canvas.figure


def _levels(axes: Axes, cells: Iterable[Cell], color: str, stroke: Stroke = "-") -> None:
    for cell in cells:
        hollow = is_cut_short(cell)
        level(axes, frame_us(cell) or 0.0, color, stroke=stroke, is_hollow=hollow)


def _tell_ratio(panel: Panel) -> None:
    """Over the panel: CBGroup beside the best MAXGAP; of several regions, the worst."""
    ratios = [c.cbgroup_ratio for c in contests(panel.cells) if c.form == ONE_STATEMENT]
    if ratios:
        head(panel.axes, panel.name, f"{max(ratios):.2f}")


def draw_figure9_rows(plot: Plot) -> Figure:
    """Ranges, rows and false rows against MAXGAP, CBGroup's as lines."""
    legend: list[Artist] = [
        entry(label, color, line="-", marker=marker) for label, color, marker in COUNTED.values()
    ]
    legend.append(entry("dashed: CBGroup's", FAINT, line="--"))
    canvas, panels = by_layout_and_engine(plot, framing_of(plot, legend))
    places = gap_places(plot.cells)
    most = max(
        (v for cell in plot.cells for key in COUNTED if (v := number(cell, key))), default=1.0
    )
    for panel in panels:
        own = _counted_once(panel.cells)
        for key, (_, color, marker) in COUNTED.items():
            known = sorted(
                (places[0](gap), value, is_cut_short(cell))
                for cell in own
                if cell.get("strategy") == "maxgap"
                and (gap := number(cell, "maxgap")) is not None
                and (value := number(cell, key)) is not None
            )
            line(panel.axes, known, color, marker=marker, size=3.8)
            for cell in own:
                value = number(cell, key)
                if cell.get("strategy") == "cbgroup" and value is not None:
                    level(panel.axes, value, color, stroke="--")
        _gap_axis(panel, places)
        _count_axis(panel, most)
    return canvas.figure


def _counted_once(cells: Sequence[Cell]) -> Sequence[Cell]:
    """Cells of one form and one cache: counts depend on neither."""
    with_form = [{**cell, "form": form_of(cell)} for cell in cells]
    return next(iter(grouped(with_form, ("form", "cache", "file")).values()), ())


def _count_axis(panel: Panel, most: float) -> None:
    """Logarithmic from 1 on, and linear below, so that 0 has its place."""
    panel.axes.set_yscale("symlog", linthresh=1.0, linscale=0.6)
    panel.axes.set_ylim(-0.15, most * 1.6)
    ticks = [0.0, *(10.0**n for n in range(math.floor(math.log10(max(most, 1.0) * 1.6)) + 1))]
    if len(ticks) > 7:
        ticks = ticks[:2] + ticks[3::2]
    fix_ticks(panel.axes.yaxis, ticks, [count(tick) for tick in ticks])
    panel.axes.grid(visible=True, axis="y", color=RULE, linewidth=0.7)
    label_outer_y(panel, "a frame")


def draw_figure10(plot: Plot) -> Figure:
    """As Figure 9, a curve and a line for each region of other density."""
    regions = distinct(plot.cells, "region")
    looks = {region: REGIONS.get(region, (INK, "^")) for region in regions}
    legend: list[Artist] = [
        entry(_region_name(plot.cells, region), color, line="-", marker=marker)
        for region, (color, marker) in looks.items()
    ]
    legend.append(entry("CBGroup, in the region's colour", FAINT, line="-", width=2.2))
    if any(form_of(cell) == IN_THE_SERVER for cell in plot.cells):
        legend.append(entry("dashed: a loop in the server", FAINT, line="--"))
    notes = [f"{WITH_RATIO}; the largest of the regions."]
    canvas, panels = by_layout_and_engine(plot, framing_of(plot, legend, notes))
    places = gap_places(plot.cells)
    for panel in panels:
        _draw_regions(panel, looks, places[0])
        _gap_axis(panel, places)
        _tell_ratio(panel)
    share_times(panels, "y", times(plot.cells), "time a frame")
    return canvas.figure


def _draw_regions(panel: Panel, looks: Mapping[str, tuple[str, str]], place: Place) -> None:
    for region, (color, marker) in looks.items():
        own = [cell for cell in panel.cells if cell.get("region") == region]
        for form, stroke in STROKES.items():
            line(
                panel.axes, _curve(own, place, form), color, stroke=stroke, marker=marker, size=3.8
            )
            _levels(panel.axes, with_strategy(own, "cbgroup", form), color, stroke)


def _region_name(cells: Iterable[Cell], region: str) -> str:
    shares = {
        density
        for cell in cells
        if cell.get("region") == region and (density := number(cell, "density")) is not None
    }
    share = f" ({100 * max(shares):.2g} % occupied)" if len(shares) == 1 else ""
    return f"MaxGap, {region} density{share}"
