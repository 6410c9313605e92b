"""What the paper leaves out, as plots: caches, strategies, curves, points, slow frames."""

from collections.abc import Iterable

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticdb.bench.cells import (
    FRAME_US,
    Cell,
    distinct,
    frame_us,
    grouped,
    is_cut_short,
    named,
    with_strategy,
)
from hapticdb.bench.drawing.canvas import (
    FAINT,
    GREY,
    INK,
    RULE,
    SKY,
    STRATEGY_COLORS,
    Stroke,
    category_axis,
    entry,
    fix_ticks,
    log_axis,
    marks,
)
from hapticdb.bench.drawing.panels import (
    TYPICAL,
    along,
    by_layout_and_engine,
    framing_of,
    line,
    look_of,
    mark_millisecond,
    millisecond_entry,
    share_times,
    strategy_entries,
    times,
)
from hapticdb.bench.drawing.plots import Plot

POINTS_SHOWN = ("points", "array", "cbgroup", "auto")
CACHES = (
    "Below the panels: the database's own cache; whether the operating system's cache holds the "
    "file, or both were emptied before each frame (cold)."
)
TAIL = (("p50", INK, "o"), ("p99", STRATEGY_COLORS["array"], "s"), ("p99.9", SKY, "D"))


def dodged(number: int, among: int, room: float = 0.56) -> float:
    """Offset of one mark of several at the same place."""
    return 0.0 if among < 2 else room * (number / (among - 1) - 0.5)


def draw_conditions(plot: Plot) -> Figure:
    """Strategies beside each other at every combination of caches."""
    strategies = distinct(plot.cells, "strategy")
    caches = list(grouped(plot.cells, ("cache", "file")))
    legend = [*strategy_entries(strategies), millisecond_entry()]
    framing = framing_of(plot, legend, [TYPICAL, CACHES])
    canvas, panels = by_layout_and_engine(plot, framing)
    for panel in panels:
        for place, cache in enumerate(caches):
            own = [c for c in panel.cells if (c.get("cache"), c.get("file")) == cache]
            for number, strategy in enumerate(strategies):
                x = place + dodged(number, len(strategies))
                _mark(panel.axes, own, strategy, x)
        # side by side there is room for one word
        names = [
            f"{str(cache or '').removesuffix(' cached')}\n{file or ''}" for cache, file in caches
        ]
        fix_ticks(panel.axes.xaxis, range(len(caches)), names if panel.is_lowest else [])
        panel.axes.set_xlim(-0.6, len(caches) - 0.4)
        for between in range(1, len(caches)):
            panel.axes.axvline(between - 0.5, color=RULE, linewidth=0.7)
        mark_millisecond(panel.axes, "y")
    share_times(panels, "y", [*times(plot.cells), FRAME_US], "time a frame")
    return canvas.figure


def _mark(axes: Axes, cells: Iterable[Cell], strategy: str, x: float) -> None:
    own = with_strategy(cells, strategy)
    places = [(x, frame_us(cell) or 0.0, is_cut_short(cell)) for cell in own]
    marks(axes, places, *look_of(strategy), 6)


def whisker(axes: Axes, cell: Cell, y: float, color: str, marker: str = "o") -> None:
    """Draw half of the frames as a mark, and a line from there to 99 in 100."""
    half, most = frame_us(cell, "p50"), frame_us(cell, "p99")
    if half is None:
        return
    if most is not None:
        axes.plot([half, most], [y, y], color=color, linewidth=1.6)
        axes.plot([most], [y], color=color, marker="|", markersize=8, markeredgewidth=1.6)
    marks(axes, [(half, y, is_cut_short(cell))], color, marker, 6)


def draw_strategies(plot: Plot) -> Figure:
    """Half of the frames and 99 in 100 for each strategy."""
    strategies = distinct(plot.cells, "strategy")
    legend: list[Artist] = [
        entry("p50", INK, marker="o"),
        entry("up to p99", INK, line="-", marker="|"),
        entry("p50 of auto", STRATEGY_COLORS["auto"], line="--", width=1.0),
        millisecond_entry(),
    ]
    height = 0.3 * len(strategies) + 0.3
    canvas, panels = by_layout_and_engine(plot, framing_of(plot, legend, height=height))
    for panel in panels:
        for y, strategy in enumerate(strategies):
            for cell in with_strategy(panel.cells, strategy):
                whisker(panel.axes, cell, y, *look_of(strategy))
        for auto in times(with_strategy(panel.cells, "auto"), "p50"):
            panel.axes.axvline(auto, color=INK, linestyle="--", linewidth=1.0, zorder=1)
        category_axis(panel.axes, [named(s) for s in strategies], is_labelled=panel.is_left)
        mark_millisecond(panel.axes, "x")
    share_times(panels, "x", [*times(plot.cells, "p50", "p99"), FRAME_US], "time a frame")
    return canvas.figure


def draw_points(plot: Plot) -> Figure:
    """Time against the number of points, a line for each strategy."""
    known = distinct(plot.cells, "strategy")
    strategies = [s for s in POINTS_SHOWN if s in known] or known
    legend = [*strategy_entries(strategies, "-"), millisecond_entry()]
    canvas, panels = by_layout_and_engine(plot, framing_of(plot, legend, [TYPICAL]))
    numbers = [float(n) for n in distinct(plot.cells, "points") if n > 0]
    shown = [cell for cell in plot.cells if cell.get("strategy") in strategies]
    for panel in panels:
        for strategy in strategies:
            own = along(with_strategy(panel.cells, strategy), "points")
            color, marker = look_of(strategy)
            # over the strategy that it has chosen
            stroke: Stroke = "--" if strategy == "auto" else "-"
            line(panel.axes, own, color, stroke=stroke, marker=marker)
        log_axis(panel.axes, "x", numbers, ticks=numbers if len(numbers) <= 6 else ())
        if panel.is_lowest:
            panel.axes.set_xlabel("points of the shell")
        mark_millisecond(panel.axes, "y")
    share_times(panels, "y", [*times(shown), FRAME_US], "time a frame")
    return canvas.figure


def draw_tail(plot: Plot) -> Figure:
    """Half of the frames, 99 in 100, 999 in 1000 and the worst; what p99 makes a second."""
    strategies = distinct(plot.cells, "strategy")
    legend: list[Artist] = [entry(name, color, marker=marker) for name, color, marker in TAIL]
    legend += [entry("worst frame", GREY, marker="x"), millisecond_entry()]
    notes = ["At the right of each row: frames a second that follow from p99."]
    if all(frame_us(cell, "p99.9") is None for cell in plot.cells):
        legend.pop(2)
    if any(frame_us(cell, "p99.9") is None for cell in plot.cells):
        notes.append("p99.9 is left out below 10,000 frames a cell.")
    height = 0.32 * len(strategies) + 0.3
    framing = framing_of(plot, legend, notes, height=height, right=0.75, between=0.75)
    canvas, panels = by_layout_and_engine(plot, framing)
    for panel in panels:
        for y, strategy in enumerate(strategies):
            for cell in with_strategy(panel.cells, strategy):
                _draw_tail_row(panel.axes, cell, y)
        category_axis(panel.axes, [named(s) for s in strategies], is_labelled=panel.is_left)
        mark_millisecond(panel.axes, "x")
    spread = times(plot.cells, "p50", "p99", "p99.9", "max")
    share_times(panels, "x", [*spread, FRAME_US], "time a frame")
    return canvas.figure


def _draw_tail_row(axes: Axes, cell: Cell, y: float) -> None:
    known = times([cell], "p50", "p99", "p99.9", "max")
    axes.plot([min(known), max(known)], [y, y], color=GREY, linewidth=0.9)
    for measure, color, marker in TAIL:
        places = [(time, y, is_cut_short(cell)) for time in times([cell], measure)]
        marks(axes, places, color, marker)
    axes.plot(times([cell], "max"), [y] * len(times([cell], "max")), "x", color=GREY, zorder=3)
    for slow in times([cell], "p99"):
        axes.text(
            1.02,
            y,
            f"{1e6 / slow:,.0f} /s",
            transform=axes.get_yaxis_transform(),
            va="center",
            color=FAINT,
        )
