"""The plots of docs/evaluation.md: the claim, the paper's figures, users and scale."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
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
    figure.subplots(rows, count // rows, sharey="row" if count != 2 else False)
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


def claim(cells: Sequence[Cell]) -> Figure:
    """Frames a second: a panel a kind of poses, a column of marks a place, a mark a strategy."""
    place = "engine", "layout", "law", "file"
    kinds = distinct(cells, "poses")
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    figure.subplots(1, len(kinds), sharey="row")
    for axes, kind in zip(figure.axes, kinds, strict=True):
        all_ = [cell for cell in cells if cell["poses"] == kind]
        own = [cell for cell in all_ if cell["strategy"] != "bitmap"]
        places = list(grouped(own, place))
        for (strategy,), marks in grouped(own, ("strategy",)).items():
            x = [places.index(tuple(cell[key] for key in place)) for cell in marks]
            y = [1e6 / typical(cell) for cell in marks]
            axes.plot(x, y, "o", markersize=4, label=named(strategy))
        for cell in all_:
            if cell["strategy"] == "bitmap":
                axes.axhline(1e6 / typical(cell), color="black", label="dense bitmap in memory")
        axes.axhline(1e6 / FRAME_US, color="grey", linestyle="--", label="the paper: 1,000")
        names = [
            f"{engine.rpartition('.')[0]}\n{named(layout)}, {law}" + ", cold" * (file == "cold")
            for engine, layout, law, file in places
        ]
        axes.set(yscale="log", title=f"{kind} poses")
        axes.set_xticks(range(len(places)), names, rotation=90, fontsize=6)
        axes.grid(visible=True, linewidth=0.3)
    figure.axes[0].set_ylabel("frames a second")
    figure.axes[-1].legend(fontsize=6)
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
    "figure9": partial(against_maxgap, by=("law",)),
    "figure10": partial(against_maxgap, by=("region",)),
    "claim": claim,
    "scale": scale,
}


def draw(results: Results, folder: Path) -> None:
    """Draw each plot whose experiment was measured, as SVG; the same results give the same file."""
    with rc_context({"svg.hashsalt": "hapticdb", "svg.fonttype": "none", "font.size": 8}):
        for name, plot in PLOTS.items():
            if name in results:
                figure = plot(results[name]["cells"])
                figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
