"""The page of `hapticdb bench`: what was measured on one environment, in plots and tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from hapticdb.bench.cells import Cell, Results, cells_of, named, number, word
from hapticdb.bench.drawing.draw import KINDS
from hapticdb.bench.drawing.plots import plots_among
from hapticdb.bench.markdown import (
    NONE,
    bullets,
    bytes_text,
    count_text,
    fact_table,
    image,
    notes_of,
    paragraphs,
    section,
    versions_of,
    write_page,
)
from hapticdb.bench.tables import best_maxgap, by_strategy, costs, figure8, tail

OPENING = (
    "Written by `hapticdb bench` from the JSON beside this page. A frame is one evaluation of the "
    "wrench. Times are in microseconds; *How to read*, below, says how they were taken."
)
READING = """\
- **Typical** is the mean of the frames between the 5th and the 95th percentile: as steady as a
  median, and every kind of pose counts by its share. p99 is the time that 99 in 100 frames keep;
  p99.9 is given from 10,000 frames on.
- **Ratios** count more than times: machines differ and are noisy. Strategies on one environment ran
  in turns.
- **Database cache** is the engine's own: 4 MB, as in the paper, or large enough for all. **File**
  cached: the operating system holds the database's pages; cold: before each frame that cache and
  the database's own were emptied.
- **Ranges, rows, false rows** are means a frame; false rows were read, but no point asked for them.
  One session measures alone.
- **Hollow marks** in plots, stars in tables: the time limit ended the cell early."""


@dataclass(frozen=True)
class PageSection:
    """One experiment on the page.

    experiment : its name; title : headline; asked : what is compared, in a sentence or two; table :
    its cells as Markdown.
    """

    experiment: str
    title: str
    asked: str
    table: Callable[[Sequence[Cell]], str]


SECTIONS = (
    PageSection(
        "strategies",
        "Strategies",
        "Each strategy answers the same poses: a sphere of 300 points that slides over the largest "
        "objects, the same sphere at random poses near surfaces, and the recorded path of your own "
        "tool where one was given.",
        by_strategy,
    ),
    PageSection(
        "tail",
        "The slowest frames",
        "Sliding poses, often enough to show the slowest frames of each strategy.",
        tail,
    ),
    PageSection(
        "points",
        "Points of the shell",
        "Spheres of more points. The sphere grows with them, so that they stay as dense.",
        by_strategy,
    ),
    PageSection(
        "conditions",
        "Caches",
        "A database cache of 4 MB, as in the paper, and one that holds all; the file in the "
        "operating system's cache, and cold. A server keeps the cache that it was started with.",
        by_strategy,
    ),
    PageSection(
        "figure9",
        "MaxGap against CBGroup (the paper's Figure 9)",
        "MaxGap closes every gap of at most MAXGAP voxel keys; the table has the fastest of all "
        "MAXGAP that were tried. CBGroup decides each gap by its cost and has no parameter. The "
        "ratio is CBGroup's time over that of the best MAXGAP.",
        best_maxgap,
    ),
    PageSection(
        "figure10",
        "Voxel density (the paper's Figure 10)",
        "The same in three regions: around the 10th, the 50th and the 90th percentile of the share "
        "of occupied voxels in windows around surface voxels.",
        best_maxgap,
    ),
    PageSection(
        "figure8",
        "Resolution of the quantile vector (the paper's Figure 8)",
        "CBGroup estimates the rows in a gap by a quantile vector: the more buckets, the closer.",
        figure8,
    ),
    PageSection(
        "costs",
        "Costs that the grouping stands on",
        "What `cbgroup` and `auto` decide by.",
        costs,
    ),
)


def write_bench_page(results: Results, path: Path) -> None:
    """Write what was measured on one environment as Markdown.

    Parameters
    ----------
    results : mapping
        Results by name, as their JSON holds them. Experiments without cells are left out.
    path : Path
        The Markdown file, in the folder of the plots; that is made when it does not exist.

    Raises
    ------
    FileError
        A file that cannot be written.
    """
    first = next(iter(results.values()), {})
    environment = next(iter(cells_of(results, "table1")), {})
    name = word(environment, "environment") or "an environment"
    write_page(
        path,
        [
            f"# Frames on {name}",
            OPENING,
            fact_table(_environment_facts(environment)),
            *(_section_text(one, results) for one in SECTIONS),
            "## How to read",
            READING,
            section("Machine", fact_table(first.get("machine") or {})),
            section("Versions", fact_table(versions_of(first))),
            section("Inputs", fact_table(first.get("inputs") or {})),
        ],
    )


def _environment_facts(cell: Cell) -> dict[str, str]:
    """What the environment is, in words; what is not known is left out."""
    layout = word(cell, "layout")
    size, edge = number(cell, "voxel_size"), number(cell, "edge")
    known = {
        "engine": word(cell, "engine"),
        "layout": named(layout),
        "objects": count_text(number(cell, "objects")),
        "object voxels": count_text(number(cell, "object_voxels")),
        "rows": count_text(number(cell, f"rows_{layout}")),
        "size": bytes_text(number(cell, f"bytes_{layout}")),
        "bits an axis": count_text(number(cell, "bits")),
        "voxel size": f"{1000 * size:.4g} mm" if size else "",
        "edge of the grid": f"{edge:.4g} m" if edge else "",
    }
    return {name: text for name, text in known.items() if text and text != NONE}


def _section_text(one: PageSection, results: Results) -> str:
    """One experiment; empty when it has no cells."""
    cells = cells_of(results, one.experiment)
    if not cells:
        return ""
    plots = [
        image(plot.caption, f"{plot.name}.svg")
        for plot in plots_among(results, KINDS)
        if plot.kind.experiment == one.experiment
    ]
    notes = notes_of(results[one.experiment])
    return paragraphs(f"## {one.title}", one.asked, *plots, one.table(cells), bullets(notes))
