"""What several plots share: a panel for each layout and engine, lines and levels in it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from matplotlib.artist import Artist
from matplotlib.axes import Axes

from hapticdb.bench.cells import FRAME_US, Cell, distinct, frame_us, is_cut_short, named, number
from hapticdb.bench.drawing.canvas import (
    CUT_SHORT,
    INK,
    STRATEGY_COLORS,
    STRATEGY_MARKERS,
    Canvas,
    Framing,
    Stroke,
    entry,
    head,
    lay_out,
    log_axis,
    marks,
    not_measured,
)
from hapticdb.bench.drawing.plots import Plot

TYPICAL = "Times are typical ones: the mean between the 5th and the 95th percentile."
MILLISECOND_ENTRY = "1 ms: 1000 frames a second"


@dataclass(frozen=True)
class Panel:
    """One panel: what it shows, where it stands, and its cells."""

    axes: Axes
    cells: Sequence[Cell]
    name: str
    is_left: bool
    is_lowest: bool


def framing_of(
    plot: Plot,
    legend: Sequence[Artist] = (),
    notes: Sequence[str] = (),
    *,
    height: float = 2.1,
    left: float = 0.85,
    right: float = 0.15,
    between: float = 0.2,
    above: float = 0.34,
) -> Framing:
    """Title, conditions and footnotes of a plot around panels of some size."""
    said = [*notes, CUT_SHORT] if any(is_cut_short(cell) for cell in plot.cells) else notes
    sizes = (height, left, right, between, above)
    return Framing(plot.kind.title, plot.conditions, said, legend, *sizes)


def by_layout_and_engine(plot: Plot, framing: Framing) -> tuple[Canvas, list[Panel]]:
    """A row for each layout, a column for each engine; those without cells say so."""
    layouts = distinct(plot.cells, "layout") or [None]
    engines = distinct(plot.cells, "engine") or [None]
    canvas = lay_out(framing, len(layouts), len(engines))
    panels = []
    for row, layout in enumerate(layouts):
        for column, engine in enumerate(engines):
            axes = canvas.panels[row][column]
            cells = [
                cell
                for cell in plot.cells
                if cell.get("layout") == layout and cell.get("engine") == engine
            ]
            name = ", ".join(named(part) for part in (engine, layout) if part is not None)
            head(axes, name)
            if not cells:
                not_measured(axes)
            panels.append(Panel(axes, cells, name, column == 0, row == len(layouts) - 1))
    return canvas, panels


def share_times(
    panels: Iterable[Panel], name: Literal["x", "y"], values: Sequence[float], label: str
) -> None:
    """Give all panels the same axis of times, with its name at the outer panels only."""
    for panel in panels:
        log_axis(panel.axes, name, values, unit="us")
        if name == "y":
            label_outer_y(panel, label)
        elif panel.is_lowest:
            panel.axes.set_xlabel(label)


def label_outer_y(panel: Panel, label: str) -> None:
    """Name the y axis and its ticks where a panel stands at the left, and nowhere else."""
    if panel.is_left:
        panel.axes.set_ylabel(label)
    else:
        panel.axes.tick_params(axis="y", labelleft=False)


def times(cells: Iterable[Cell], *measures: str) -> list[float]:
    """All times of some cells that were measured."""
    return [
        value
        for cell in cells
        for measure in measures or ("typical",)
        if (value := frame_us(cell, measure)) is not None
    ]


def along(
    cells: Iterable[Cell], key: str, measure: str = "typical"
) -> list[tuple[float, float, bool]]:
    """Places (value of a key, time, whether cut short) in ascending order of the key."""
    return sorted(
        (x, y, is_cut_short(cell))
        for cell in cells
        if (x := number(cell, key)) is not None and (y := frame_us(cell, measure)) is not None
    )


def line(
    axes: Axes,
    places: Sequence[tuple[float, float, bool]],
    color: str,
    *,
    stroke: Stroke = "-",
    marker: str = "o",
    size: float = 4.5,
) -> None:
    """Draw a line through places, with marks."""
    axes.plot([x for x, *_ in places], [y for _, y, _ in places], linestyle=stroke, color=color)
    marks(axes, places, color, marker, size)


def level(
    axes: Axes,
    y: float,
    color: str,
    *,
    stroke: Stroke = "-",
    width: float = 1.6,
    is_hollow: bool = False,
) -> None:
    """Draw a horizontal line, with a hollow mark at its end when its cell was cut short."""
    axes.axhline(y, color=color, linestyle=stroke, linewidth=width, zorder=2)
    if is_hollow:
        axes.plot(
            [0.98],
            [y],
            transform=axes.get_yaxis_transform(),
            color=color,
            marker="o",
            markerfacecolor="white",
        )


def mark_millisecond(axes: Axes, name: Literal["x", "y"]) -> None:
    """Draw the time that a frame may take at 1000 a second."""
    draw = axes.axvline if name == "x" else axes.axhline
    draw(FRAME_US, color=INK, linestyle=":", linewidth=1.2, zorder=1)


def millisecond_entry() -> Artist:
    """Entry of the legend for the line of one millisecond."""
    return entry(MILLISECOND_ENTRY, INK, line=":", width=1.2)


def look_of(strategy: str) -> tuple[str, str]:
    """Colour and marker of a strategy, the same in all plots."""
    return STRATEGY_COLORS.get(strategy, INK), STRATEGY_MARKERS.get(strategy, "o")


def strategy_entries(strategies: Iterable[str], stroke: Stroke = "none") -> list[Artist]:
    """Entries of the legend for some strategies."""
    looks = [(named(strategy), *look_of(strategy)) for strategy in strategies]
    return [entry(name, color, line=stroke, marker=marker) for name, color, marker in looks]
