"""The numbers in the tables of the pages come from results/, and every result stands on a page."""

import re
from pathlib import Path

import pytest

import records
from page_tables import MARK, filled, tables
from sources import ROOT

RESULTS = ROOT / "results"
NUMBER = re.compile(r"\d[\d,.]*(?:e[-+]?\d+)?")
PAGES = [path for path in sorted((ROOT / "docs").glob("*.md")) if MARK.search(path.read_text())]


def numbers_of(page: str) -> dict[str, list[str]]:
    """The numbers below each mark of a page, by its name."""
    return {mark[2]: NUMBER.findall(mark[3]) for mark in MARK.finditer(page)}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.stem))
def test_page_tables_numbers_from_results(path: Path) -> None:
    """After new results: python benchmarks/page_tables.py."""
    page = path.read_text()
    made = numbers_of(filled(page, records.read(RESULTS)))
    assert numbers_of(page) == made
    assert all(made.values())


def test_page_tables_each_on_one_page() -> None:
    marks = [mark[2] for path in PAGES for mark in MARK.finditer(path.read_text())]
    assert sorted(marks) == sorted(tables())


def test_results_shown_or_named() -> None:
    text = "".join(path.read_text() for path in (ROOT / "docs").rglob("*.md"))
    used: set[str] = set()

    class Noted(dict[str, dict[str, object]]):
        """Results that note which of them are read."""

        def __getitem__(self, name: str) -> dict[str, object]:
            used.add(name)
            return super().__getitem__(name)

    for make in tables().values():
        make(Noted(records.read(RESULTS)))
    for path in RESULTS.iterdir():
        shown = f"../results/{path.name}" in text if path.suffix != ".json" else False
        assert shown or path.stem in used or f"results/{path.name}" in text, path.name
