"""All plots of an evaluation, as SVG files."""

from collections.abc import Callable, Mapping
from pathlib import Path

from matplotlib.figure import Figure

from hapticdb.bench.cells import Results
from hapticdb.bench.evaluation.page import styled, write
from hapticdb.bench.evaluation.paper_panels import (
    draw_figure8,
    draw_figure9,
    draw_figure9_rows,
    draw_figure10,
)
from hapticdb.bench.evaluation.peer_panels import draw_peers, draw_scale, draw_voxelizing
from hapticdb.bench.evaluation.sheets import Sheet, sheets
from hapticdb.bench.evaluation.strategy_panels import (
    draw_conditions,
    draw_layouts,
    draw_points,
    draw_strategies,
    draw_tail,
)

PAINTERS: Mapping[str, Callable[[Sheet], Figure]] = {
    "figure8": draw_figure8,
    "figure9": draw_figure9,
    "figure9-rows": draw_figure9_rows,
    "figure10": draw_figure10,
    "conditions": draw_conditions,
    "strategies": draw_strategies,
    "layouts": draw_layouts,
    "points": draw_points,
    "tail": draw_tail,
    "peers": draw_peers,
    "voxelizing": draw_voxelizing,
    "scale": draw_scale,
}


def draw(results: Results, folder: Path) -> list[Path]:
    """Draw every experiment that has cells.

    Parameters
    ----------
    results : mapping
        Results by name, as their JSON holds them; unknown names, missing numbers are passed over.
    folder : Path
        Where the files go; made when it does not exist. Files of the same names are replaced.

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
        for sheet in sheets(results):
            path = folder / f"{sheet.name}.svg"
            write(PAINTERS[sheet.kind.name](sheet), path)
            paths.append(path)
    return paths
