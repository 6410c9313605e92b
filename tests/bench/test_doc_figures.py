"""Every measured figure on a page is in results/, or is marked with the commit that observed it."""

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hapticdb.bench import records
from hapticdb.bench.drawing.draw import draw
from hapticdb.bench.drawing.plots import plots_among
from hapticdb.bench.feel.page import write_feel_page
from report.floods_page import flood_table
from report.hosting_page import hosted_table
from report.laws_page import law_frame_table, law_session_table
from report.page import write_report
from report.paths_page import (
    batch_ratio_table,
    batch_table,
    batch_words,
    shell_table,
    shell_words,
    way_table,
)
from report.plots import REPORT_KINDS
from report.proxies_page import proxy_table
from report.realtime_page import edit_table, frame_table, model_words, session_table
from report.remote_page import remote_table
from report.shards_page import copy_words, rebalance_words, scale_words

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
FILES = sorted(RESULTS.glob("*.json"))
# left out: evaluation.md and feel.md are computed from results/, format.md has no measurement
PAGES = [
    ROOT / "README.md",
    *(
        p
        for p in sorted((ROOT / "docs").glob("*.md"))
        if p.stem not in {"evaluation", "feel", "format"}
    ),
]
CLAIM = re.compile(
    r"\b(medians?|microseconds|p99|reached|took|were felt|of their time|on disk|actual time)\b",
    re.IGNORECASE,
)
MARKER = re.compile(
    r"<!-- (?:measured: (?P<file>results/[\w-]+\.json)|observed: [0-9a-f]{7}) -->\s*"
)


def blocks(text: str) -> Iterator[str]:
    """Paragraphs, list items and tables of a page, without fenced code."""
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    prose = re.sub(r" -->\n\n(?=    )", " -->\n", prose)  # keeps a marker with its indented code
    yield from (block for block in re.split(r"\n\s*\n|\n(?=- |\d+\. )", prose) if block.strip())


def is_claim(block: str) -> bool:
    """Whether a block speaks of a measurement and holds a number."""
    words = re.sub(r"`[^`\n]*`|\]\([^)]*\)|PostgreSQL \d+", "", MARKER.sub("", block))
    return bool(CLAIM.search(words) and re.search(r"\d", words))


def loaded(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((ROOT / name).read_text())
    return found


# --- the evaluation -----------------------------------------------------------------------------


def test_the_evaluation_is_what_the_results_say(tmp_path: Path) -> None:
    """The page equals its recomputation byte for byte: all figures come from results/."""
    page = tmp_path / "evaluation.md"
    write_report(records.read(RESULTS), page, "../results")
    assert page.read_text() == (ROOT / "docs" / "evaluation.md").read_text()


def test_the_page_of_forces_is_what_its_results_say(tmp_path: Path) -> None:
    page = tmp_path / "feel.md"
    write_feel_page(loaded("results/feel.json"), page, "../results/feel")
    assert page.read_text() == (ROOT / "docs" / "feel.md").read_text()
    for link in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        assert (ROOT / "docs" / link).is_file(), link


def test_every_plot_is_kept_and_no_other() -> None:
    wanted = {plot.name for plot in plots_among(records.read(RESULTS), REPORT_KINDS)}
    assert {path.stem for path in RESULTS.glob("*.svg")} == wanted


@pytest.mark.long
def test_the_words_of_every_plot_are_what_the_results_say(tmp_path: Path) -> None:
    for path in draw(records.read(RESULTS), tmp_path, REPORT_KINDS):
        assert words_of(path) == words_of(RESULTS / path.name), path.name


def words_of(path: Path) -> list[str]:
    root = ET.fromstring(path.read_text())  # noqa: S314 - our own file
    return ["".join(node.itertext()) for node in root.iter() if node.tag.endswith("text")]


# --- results ------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_result_names_the_one_commit_that_was_measured(path: Path) -> None:
    text = path.read_text()
    assert len(re.findall(r'"commit":', text)) == 1
    assert re.match(r"[0-9a-f]{7,40}(-dirty)?( \(.*\))?$", json.loads(text)["commit"])
    assert "hapticdb" not in json.loads(text).get("versions", {})


def test_a_result_written_in_a_clone_names_its_commit(tmp_path: Path) -> None:
    found = records.result("tail", [])
    assert found["commit"] == records.commit()
    assert re.match(r"[0-9a-f]{7,40}(-dirty)?$|unknown, version \d", found["commit"])
    assert re.match(r"unknown, version \d", records.commit(tmp_path))


# --- the other pages ----------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_measured_figure_says_where_it_comes_from(page: Path) -> None:
    """A comment before a figure names its file in results/ or the commit that brought it."""
    bare = [b for b in blocks(page.read_text()) if is_claim(b) and not MARKER.match(b)]
    assert bare == []


TABLES = {
    "results/realtime.json": [session_table, frame_table],
    "results/edits.json": [edit_table],
    "results/both_laws.json": [law_frame_table, law_session_table],
    "results/many_sessions.json": [hosted_table],
    "results/contact_proxies.json": [proxy_table],
    "results/floods.json": [flood_table],
    "results/remote_cells.json": [remote_table],
    "results/batches.json": [batch_table, batch_ratio_table],
    "results/batches_1400.json": [batch_table, batch_ratio_table],
    "results/large_shells.json": [shell_table],
    "results/ways_out.json": [way_table],
    "results/ways_out_vintage.json": [way_table],
}
WORDS = {
    "results/realtime.json": model_words,
    "results/batches.json": batch_words,
    "results/batches_1400.json": batch_words,
    "results/large_shells.json": shell_words,
    "results/shards.json": copy_words,
    "results/shards_scale.json": scale_words,
    "results/shards_rebalance.json": rebalance_words,
}


def test_every_figure_that_is_said_to_be_measured_is_in_its_file() -> None:
    """Tables equal those made from their files, prose holds the phrases made from its file."""
    shown: list[str] = []
    for page in PAGES:
        for block in blocks(page.read_text()):
            found = MARKER.match(block)
            if found is None or found["file"] is None:
                continue
            results, text = loaded(found["file"]), block[found.end() :]
            if text.startswith("|"):
                tables = [table(results) for table in TABLES[found["file"]]]
                assert text.strip() in tables, f"{page.name}: {text}"
                shown.append(text.strip())
            else:
                words = " ".join(text.split())
                for phrase in WORDS[found["file"]](results):
                    assert phrase in words, page.name
    wanted = [table(loaded(name)) for name, tables in TABLES.items() for table in tables]
    assert sorted(shown) == sorted(wanted)


def test_what_the_pages_claim_of_each_run_holds() -> None:
    assert loaded("results/floods.json")["tracebacks"] == 0
    names = ["realtime", "both_laws"]
    sessions = [one for name in names for one in loaded(f"results/{name}.json")["sessions"]]
    for one in (*sessions, *loaded("results/edits.json")["edits"]):
        assert one["unknown_frames"] == 0


@pytest.mark.parametrize(
    ("text", "is_caught"),
    [
        ("A frame took 57 us.", True),
        ("| strategy | p99 |\n| --- | --- |\n| array | 90.8 |", True),
        ("Medians over 100 poses.", True),
        ("A frame took longer.", False),
        ("The wrench falls to zero within 20 ms.", False),
        ("`took 5` is a word of SQL.", False),
        ("<!-- observed: 0123abc -->\nA frame took 57 us.", False),
    ],
)
def test_a_figure_without_a_source_is_seen(text: str, *, is_caught: bool) -> None:
    found = [b for b in blocks(text) if is_claim(b) and not MARKER.match(b)]
    assert bool(found) == is_caught
