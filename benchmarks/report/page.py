"""The written evaluation: every experiment's chapter, from the numbers alone."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hapticdb.bench.cells import Cell, Result, Results, cells_of
from hapticdb.bench.contests import contests
from hapticdb.bench.drawing.plots import plots_among
from hapticdb.bench.markdown import (
    bullets,
    fact_table,
    image,
    listed,
    notes_of,
    paragraphs,
    section,
    versions_of,
    write_page,
)
from hapticdb.bench.page import READING
from hapticdb.bench.tables import by_strategy, costs, figure8, tail
from report.paper_chapters import best_against_cbgroup, table1
from report.peer_chapters import peers, scale, voxelizing
from report.plots import REPORT_KINDS
from report.reasons import (
    how_regions_differ,
    how_resolution_matters,
    what_gaps_pay,
    why_array_wins,
    why_cbgroup_is_off,
    why_loop_differs,
)
from report.strategy_chapters import auto, conditions, layouts, points

Reasons = Callable[[Sequence[Cell]], list[str]]
LEFT_OUT = "The paper leaves this out."


@dataclass(frozen=True)
class Chapter:
    """One experiment: what the paper shows, what was measured here, and why it differs.

    experiment : its name; paper : what the paper shows, a paragraph; here : the cells as Markdown;
    why : reasons that the cells themselves show, or None.
    """

    experiment: str
    title: str
    paper: str
    here: Callable[[Sequence[Cell]], str]
    why: Reasons | None = None


def _why_figure9(cells: Sequence[Cell]) -> list[str]:
    found = contests(cells)
    return why_array_wins(found) + why_loop_differs(found) + why_cbgroup_is_off(found)


def _why_figure10(cells: Sequence[Cell]) -> list[str]:
    found = contests(cells)
    return how_regions_differ(found) + why_array_wins(found) + why_cbgroup_is_off(found)


CHAPTERS = (
    Chapter(
        "table1",
        "Table 1: environments",
        "Voxels, objects and cells of the data space of the environments that it measures.",
        table1,
    ),
    Chapter(
        "figure8",
        "Figure 8: resolution of the quantile vector",
        "The average time of a query against the resolution of the quantile vector, which is read "
        "from the engine's own statistics. 10,000 buckets are its best.",
        figure8,
        how_resolution_matters,
    ),
    Chapter(
        "figure9",
        "Figure 9: MaxGap against CBGroup",
        "MaxGap closes every gap up to MAXGAP, a parameter to be tuned: 0 is one query for each "
        "point, a large one reads many rows that no point asked for. CBGroup decides each gap by "
        "its cost and has no parameter. The paper loops over the ranges inside the server "
        "(PL/SQL); here that form (plpgsql) stands beside all ranges in one statement.",
        best_against_cbgroup,
        _why_figure9,
    ),
    Chapter(
        "figure10",
        "Figure 10: voxel density",
        "MaxGap and CBGroup in regions of low, middle and high voxel density: CBGroup adapts to "
        "each. Here the regions are chosen by measured density, around the 10th, the 50th and the "
        "90th percentile of the share of occupied voxels in windows around surface voxels.",
        best_against_cbgroup,
        _why_figure10,
    ),
    Chapter(
        "costs",
        "What the grouping stands on",
        "Costs in blocks: the navigation of a descent against the leaf blocks of a gap, and the "
        "processor's work in proportion to the blocks.",
        costs,
        what_gaps_pay,
    ),
    Chapter(
        "conditions",
        "Caches",
        "The paper measures with a database cache of 500 blocks of 8 KB, 4 MB. The other "
        "conditions are not in it.",
        conditions,
    ),
    Chapter("strategies", "Strategies", LEFT_OUT, by_strategy),
    Chapter(
        "layouts",
        "Curves and layouts",
        "Z-order. Bricks and the other curves are not in it.",
        layouts,
    ),
    Chapter("points", "Points of the shell", LEFT_OUT, points),
    Chapter("tail", "The slowest frames", "The paper gives averages.", tail),
    Chapter("peers", "Peers", LEFT_OUT, peers),
    Chapter("voxelizing", "Voxelizing", LEFT_OUT, voxelizing),
    Chapter("scale", "Scale", LEFT_OUT, scale),
)
OPENING = (
    "Written by the benchmarks from the JSON beside the plots; edits are lost. A time is one "
    "frame: the tool's points placed, keys found, grouped, fetched from the database, false hits "
    "dropped, the wrench summed."
)


def write_report(results: Results, path: Path, pictures: str) -> None:
    """Write the evaluation as Markdown.

    Parameters
    ----------
    results : mapping
        Results by name, as their JSON holds them. Experiments that are missing are named.
    path : Path
        The Markdown file; its folder is made when it does not exist.
    pictures : str
        Folder of the SVG files that `plots.draw` wrote, as seen from that file.

    Raises
    ------
    FileError
        A file that cannot be written.
    """
    parts = ["# Evaluation", OPENING, _how_to_read(results)]
    parts += [_chapter(chapter, results, pictures) for chapter in CHAPTERS]
    parts.insert(len(parts) - 3, _auto_chapter(results))
    write_page(path, parts)


def _chapter(chapter: Chapter, results: Results, pictures: str) -> str:
    """One experiment; empty when it has neither cells nor notes."""
    cells = cells_of(results, chapter.experiment)
    notes = notes_of(results.get(chapter.experiment, {}))
    if not cells and not notes:
        return ""
    folder = pictures.rstrip("/")
    drawn = [
        image(plot.caption, f"{folder}/{plot.name}.svg")
        for plot in plots_among(results, REPORT_KINDS)
        if plot.kind.experiment == chapter.experiment
    ]
    here = paragraphs(*drawn, chapter.here(cells)) if cells else ""
    reasons = chapter.why(cells) if chapter.why and cells else []
    return paragraphs(
        f"## {chapter.title}",
        section("The paper", chapter.paper),
        section("Here", paragraphs(here, bullets(notes))),
        section("Why it differs", bullets(reasons)),
    )


def _auto_chapter(results: Results) -> str:
    here = auto(results)
    if not here:
        return ""
    return paragraphs("## `auto`: does the cost model choose well?", section("Here", here))


# --- how to read --------------------------------------------------------------------------------


def _how_to_read(results: Results) -> str:
    facts = [
        section("Machine", _facts(results, lambda result: result.get("machine"))),
        section("Versions", _facts(results, versions_of)),
        section("Inputs", _facts(results, lambda result: result.get("inputs"))),
    ]
    missing = [chapter.title for chapter in CHAPTERS if not cells_of(results, chapter.experiment)]
    absent = f"Not measured in this run: {listed(missing)}." if missing else ""
    return paragraphs("## How to read", READING, *facts, absent)


def _facts(results: Results, facts_of: Callable[[Result], object]) -> str:
    """Machine, versions or inputs of the experiments: one table when all are the same."""
    said: dict[str, list[str]] = {}
    for chapter in CHAPTERS:
        found = facts_of(results.get(chapter.experiment, {}))
        if isinstance(found, Mapping) and found:
            said.setdefault(fact_table(found), []).append(chapter.title)
    if len(said) == 1:
        return next(iter(said))
    most = max(said, key=lambda facts: len(said[facts]), default="")
    others = [title for facts, titles in said.items() if facts != most for title in titles]
    labels = {facts: listed(titles) for facts, titles in said.items()}
    labels[most] = f"All but {listed(others)}"
    return paragraphs(*(f"{labels[facts]}:\n\n{facts}" for facts in said))
