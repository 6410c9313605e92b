"""Strategies by layout and curve, as a plot."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticdb.bench.cells import (
    Cell,
    distinct,
    frame_us,
    grouped,
    is_cut_short,
    named,
    with_strategy,
)
from hapticdb.bench.drawing.canvas import RULE, category_axis, head, lay_out, marks
from hapticdb.bench.drawing.panels import (
    TYPICAL,
    Panel,
    framing_of,
    look_of,
    share_times,
    strategy_entries,
    times,
)
from hapticdb.bench.drawing.plots import Plot
from hapticdb.bench.drawing.strategy_plots import dodged


def draw_layouts(plot: Plot) -> Figure:
    """Curves on both layouts, a panel for each engine."""
    engines = distinct(plot.cells, "engine") or [None]
    kinds = list(grouped(plot.cells, ("layout", "curve")))
    strategies = distinct(plot.cells, "strategy")
    framing = framing_of(
        plot,
        strategy_entries(strategies),
        [TYPICAL],
        height=0.42 * len(kinds) + 0.3,
        left=1.55,
    )
    canvas = lay_out(framing, 1, len(engines))
    panels = []
    for column, (axes, engine) in enumerate(zip(canvas.panels[0], engines, strict=True)):
        cells = [cell for cell in plot.cells if cell.get("engine") == engine]
        panels.append(Panel(axes, cells, str(engine or ""), column == 0, is_lowest=True))
        head(axes, str(engine or ""))
        for place, kind in enumerate(kinds):
            own = [cell for cell in cells if (cell.get("layout"), cell.get("curve")) == kind]
            _mark_in_row(axes, own, strategies, place)
            if place:
                axes.axhline(place - 0.5, color=RULE, linewidth=0.7)
        names = [", ".join(named(part) for part in kind if part is not None) for kind in kinds]
        category_axis(axes, names, is_labelled=column == 0)
    share_times(panels, "x", times(plot.cells), "time a frame")
    return canvas.figure


def _mark_in_row(
    axes: Axes, cells: Sequence[Cell], strategies: Sequence[str], place: float
) -> None:
    for number, strategy in enumerate(strategies):
        y = place + dodged(number, len(strategies), 0.5)
        own = with_strategy(cells, strategy)
        found = [(frame_us(cell) or 0.0, y, is_cut_short(cell)) for cell in own]
        marks(axes, found, *look_of(strategy), 6)
