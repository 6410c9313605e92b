"""The written evaluation: every experiment's chapter, from the numbers alone."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hapticdb.bench.cells import Cell, Result, Results, cells_of
from hapticdb.bench.evaluation.cost_chapter import costs, what_gaps_pay
from hapticdb.bench.evaluation.findings import contests
from hapticdb.bench.evaluation.paper_chapters import best_against_cbgroup, figure8, table1
from hapticdb.bench.evaluation.peer_chapters import peers, scale, voxelizing
from hapticdb.bench.evaluation.prose import bullets, listed, paragraphs, table
from hapticdb.bench.evaluation.sheets import Sheet, sheets_of
from hapticdb.bench.evaluation.strategy_chapters import (
    auto,
    by_strategy,
    conditions,
    layouts,
    points,
    tail,
)
from hapticdb.bench.evaluation.why import (
    how_regions_differ,
    how_resolution_matters,
    why_array_wins,
    why_cbgroup_is_off,
    why_loop_differs,
)
from hapticdb.errors import FileError

Reasons = Callable[[Sequence[Cell]], list[str]]
LEFT_OUT = "The paper leaves this out."


@dataclass(frozen=True)
class Chapter:
    """One experiment: what the paper shows, what is seen here, and why.

    paper : a paragraph; here : the cells in Markdown; why : reasons that the cells bear out.
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
AUTO = "auto"
"""Chapter of all experiments together; evidence may be given for it, too."""
OPENING = (
    "Written by the benchmarks from the JSON beside the plots; edits are lost. A time is one "
    "frame: the tool's points placed, keys found, grouped, fetched from the database, false hits "
    "dropped, the wrench summed."
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


def write_report(
    results: Results, path: Path, pictures: str, evidence: Mapping[str, str] | None = None
) -> None:
    """Write the evaluation as Markdown.

    Parameters
    ----------
    results : mapping
        Results by name, as their JSON holds them. Experiments that are missing are named.
    path : Path
        The Markdown file; its folder is made when it does not exist.
    pictures : str
        Folder of the SVG files that `plots.draw` wrote, as seen from that file.
    evidence : mapping, optional
        Markdown paragraphs by experiment (or ``auto``) that explain more than the cells can.

    Raises
    ------
    FileError
        A file that cannot be written.
    """
    told = evidence or {}
    parts = ["# Evaluation", OPENING, _how_to_read(results)]
    parts += [_chapter(chapter, results, pictures, told) for chapter in CHAPTERS]
    parts.insert(len(parts) - 3, _auto_chapter(results, told))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(paragraphs(*parts) + "\n", encoding="utf-8")
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error


def _chapter(chapter: Chapter, results: Results, pictures: str, evidence: Mapping[str, str]) -> str:
    """One experiment; empty when it has neither cells nor notes."""
    cells = cells_of(results, chapter.experiment)
    notes = _notes(results.get(chapter.experiment, {}))
    if not cells and not notes:
        return ""
    folder = pictures.rstrip("/")
    drawn = [
        f"![{_alternative(sheet)}]({folder}/{sheet.name}.svg)"
        for sheet in sheets_of(results, chapter.experiment)
    ]
    here = paragraphs(*drawn, chapter.here(cells)) if cells else ""
    reasons = chapter.why(cells) if chapter.why and cells else []
    why = paragraphs(bullets(reasons), evidence.get(chapter.experiment, ""))
    return paragraphs(
        f"## {chapter.title}",
        _section("The paper", chapter.paper),
        _section("Here", paragraphs(here, bullets(notes))),
        _section("Why it differs", why),
    )


def _alternative(sheet: Sheet) -> str:
    """What stands for a picture that is not seen; brackets would end it."""
    text = ": ".join(filter(None, [sheet.kind.title, sheet.conditions]))
    return text.replace("[", "(").replace("]", ")")


def _section(title: str, text: str) -> str:
    return f"### {title}\n\n{text}" if text.strip() else ""


def _notes(result: Result) -> list[str]:
    return [" ".join(str(note).split()) for note in result.get("notes") or ()]


def _auto_chapter(results: Results, evidence: Mapping[str, str]) -> str:
    here = auto(results)
    if not here:
        return ""
    return paragraphs(
        "## `auto`: does the cost model choose well?",
        _section("Here", here),
        _section("Why it differs", evidence.get(AUTO, "")),
    )


# --- how to read --------------------------------------------------------------------------------


def _how_to_read(results: Results) -> str:
    facts = [
        _section(title, _facts(results, key))
        for title, key in (("Machine", "machine"), ("Versions", "versions"), ("Inputs", "inputs"))
    ]
    missing = [chapter.title for chapter in CHAPTERS if not cells_of(results, chapter.experiment)]
    absent = f"Not measured in this run: {listed(missing)}." if missing else ""
    return paragraphs("## How to read", READING, *facts, absent)


def _facts(results: Results, key: str) -> str:
    """What the experiments say of themselves: once when they all say the same."""
    said: dict[str, list[str]] = {}
    for chapter in CHAPTERS:
        found = results.get(chapter.experiment, {}).get(key)
        if isinstance(found, Mapping) and found:
            said.setdefault(_fact_table(found), []).append(chapter.title)
    if len(said) == 1:
        return next(iter(said))
    most = max(said, key=lambda facts: len(said[facts]), default="")
    others = [title for facts, titles in said.items() if facts != most for title in titles]
    labels = {facts: listed(titles) for facts, titles in said.items()}
    labels[most] = f"All but {listed(others)}"
    return paragraphs(*(f"{labels[facts]}:\n\n{facts}" for facts in said))


def _fact_table(facts: Mapping[str, object]) -> str:
    return table(["", ""], [[str(name), _plain(value)] for name, value in facts.items()])


def _plain(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_plain(each) for each in value)
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {_plain(each)}" for name, each in value.items())
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    return f"{value:,}" if isinstance(value, int) else str(value)
