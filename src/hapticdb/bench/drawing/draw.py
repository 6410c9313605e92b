"""The plots of `hapticdb bench`: which there are, and their SVG files."""

from collections.abc import Iterable
from pathlib import Path

from hapticdb.bench.cells import Results, word
from hapticdb.bench.drawing.canvas import styled, write
from hapticdb.bench.drawing.paper_plots import (
    draw_figure8,
    draw_figure9,
    draw_figure9_rows,
    draw_figure10,
)
from hapticdb.bench.drawing.plots import (
    PlotKind,
    has_gap,
    has_median,
    has_number,
    has_rows,
    has_time,
    plots_among,
)
from hapticdb.bench.drawing.strategy_plots import (
    draw_conditions,
    draw_points,
    draw_strategies,
    draw_tail,
)

KINDS = (
    PlotKind(
        "figure8",
        "figure8",
        "Figure 8: resolution of the quantile vector",
        ("resolution",),
        has_number("resolution"),
        draw_figure8,
    ),
    PlotKind(
        "figure9",
        "figure9",
        "Figure 9: MaxGap against CBGroup, time a frame",
        (),
        has_gap,
        draw_figure9,
    ),
    PlotKind(
        "figure9-rows",
        "figure9",
        "Figure 9: MaxGap against CBGroup, ranges and rows",
        ("cache", "file"),
        has_rows,
        draw_figure9_rows,
    ),
    PlotKind(
        "figure10",
        "figure10",
        "Figure 10: MaxGap against CBGroup by voxel density",
        (),
        lambda cell: has_gap(cell) and bool(word(cell, "region")),
        draw_figure10,
    ),
    PlotKind(
        "conditions",
        "conditions",
        "Database's cache and operating system's cache",
        ("cache", "file"),
        has_time,
        draw_conditions,
    ),
    PlotKind(
        "strategies",
        "strategies",
        "Strategies: half of the frames, and 99 in 100",
        (),
        has_median,
        draw_strategies,
    ),
    PlotKind(
        "points",
        "points",
        "Time a frame against the shell's points",
        ("points",),
        has_number("points"),
        draw_points,
    ),
    PlotKind("tail", "tail", "The slowest frames", (), has_median, draw_tail),
)
"""What `hapticdb bench` draws."""


def draw(results: Results, folder: Path, kinds: Iterable[PlotKind] = KINDS) -> list[Path]:
    """Draw every experiment that has cells.

    Parameters
    ----------
    results : mapping
        Results by name, as their JSON holds them. Unknown names and missing numbers are passed
        over.
    folder : Path
        Where the files go; made when it does not exist. Files of the same names are replaced.
    kinds : iterable of PlotKind
        What is drawn; what `hapticdb bench` draws unless given.

    Returns
    -------
    list of Path
        The SVG files. The same results give the same bytes.

    Raises
    ------
    FileError
        A file that cannot be written.
    """
    paths = []
    with styled():
        for plot in plots_among(results, kinds):
            path = folder / f"{plot.name}.svg"
            write(plot.kind.paint(plot), path)
            paths.append(path)
    return paths
