"""The plots of docs/evaluation.md: the paper's Figures 8, 9 and 10, shells and scale."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from paper.cells import (
    FRAME_US,
    Cell,
    Results,
    distinct,
    grouped,
    named,
    typical,
    with_paper_cache,
)

SMALLEST_GAP = 3.0
"""Where MAXGAP 0 stands on a logarithmic axis."""


def lines(axes: Axes, cells: Iterable[Cell], by: Sequence[str], x: str) -> None:
    """A line of typical times for each combination of the values of `by`."""
    for values, group in grouped(cells, by).items():
        points = sorted((max(cell[x], SMALLEST_GAP), typical(cell)) for cell in group)
        label = ", ".join(named(value) for value in values if value is not None)
        axes.plot(*zip(*points, strict=True), marker="o", markersize=3, label=label)


def finish(figure: Figure, x: str) -> None:
    """Logarithmic axes, their names, a line at 1 ms, and a legend a panel."""
    for axes in figure.axes:
        axes.set(xscale="log", yscale="log", xlabel=x)
        axes.axhline(FRAME_US, color="grey", linewidth=0.6)
        axes.grid(visible=True, linewidth=0.3)
        axes.legend(fontsize=6)
    figure.axes[0].set_ylabel("typical frame, us")


def panels(count: int) -> Figure:
    """A figure of panels beside each other, in two rows if there are many."""
    rows = 2 if count > 3 else 1
    figure = Figure(figsize=(4.2 * count / rows, 3.4 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    figure.subplots(rows, count // rows, sharey="row")
    return figure


def figure_8(cells: Sequence[Cell]) -> Figure:
    """Time a frame against the resolution of the quantile vector, a panel a layout."""
    layouts = distinct(cells, "layout")
    figure = panels(len(layouts))
    for axes, layout in zip(figure.axes, layouts, strict=True):
        axes.set_title(named(layout), fontsize=9)
        lines(axes, (c for c in cells if c["layout"] == layout), ("engine",), "resolution")
    finish(figure, "buckets of the quantile vector")
    return figure


def against_maxgap(cells: Sequence[Cell], by: Sequence[str]) -> Figure:
    """MaxGap's time against MAXGAP, and CBGroup's as a level line of the same colour."""
    groups = grouped(cells, ("layout", "engine"))
    figure = panels(len(groups))
    for axes, ((layout, engine), own) in zip(figure.axes, groups.items(), strict=True):
        axes.set_title(f"{engine}, {named(layout)}", fontsize=9)
        for group in grouped(own, by).values():
            curve = [cell for cell in group if cell["strategy"] == "maxgap"]
            lines(axes, curve, (*by, "strategy"), "maxgap")
            color = axes.lines[-1].get_color()
            for cell in group:
                if cell["strategy"] == "cbgroup":
                    axes.axhline(typical(cell), color=color, linestyle=":", label="its CBGroup")
    finish(figure, "MAXGAP, voxel keys; 0 at the left")
    return figure


def figure_9(cells: Sequence[Cell]) -> Figure:
    """MaxGap against CBGroup with the paper's cache, in both forms."""
    return against_maxgap(with_paper_cache(cells), ("form",))


def figure_10(cells: Sequence[Cell]) -> Figure:
    """The same by voxel density."""
    return against_maxgap(cells, ("region",))


def points(cells: Sequence[Cell]) -> Figure:
    """Time a frame against the shell's points."""
    groups = grouped(cells, ("layout", "engine"))
    figure = panels(len(groups))
    for axes, ((layout, engine), own) in zip(figure.axes, groups.items(), strict=True):
        axes.set_title(f"{engine}, {named(layout)}", fontsize=9)
        lines(axes, own, ("strategy",), "points")
    finish(figure, "points of the shell")
    return figure


def scale(cells: Sequence[Cell]) -> Figure:
    """Time a frame against the environment's size, a panel a kind of poses."""
    groups = grouped((cell for cell in cells if "us" in cell), ("poses",))
    figure = panels(len(groups))
    for axes, ((poses,), own) in zip(figure.axes, groups.items(), strict=True):
        axes.set_title(f"{poses} poses", fontsize=9)
        lines(axes, own, ("engine", "strategy"), "object_voxels")
    finish(figure, "object voxels of the environment")
    return figure


PLOTS: dict[str, Callable[[Sequence[Cell]], Figure]] = {
    "figure8": figure_8,
    "figure9": figure_9,
    "figure10": figure_10,
    "points": points,
    "scale": scale,
}


def draw(results: Results, folder: Path) -> None:
    """Draw each plot whose experiment was measured, as SVG; the same results give the same file."""
    with rc_context({"svg.hashsalt": "hapticdb", "svg.fonttype": "none", "font.size": 8}):
        for name, plot in PLOTS.items():
            if name in results:
                figure = plot(results[name]["cells"])
                figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
