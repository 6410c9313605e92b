"""Texts of the page: short, one line, and harmless in HTML."""

import pytest

from hapticdb.page.panels.sweeps import COLOURS
from hapticdb.page.panels.tree import assemblies_of, found_ids
from hapticdb.page.wording import escaped, note_html, plain_name, rows_html, short_name
from hapticdb.verdicts import WORST

HOSTILE = '<img src=x onerror="alert(1)">&amp;</td><script>'


@pytest.mark.parametrize(
    "html", [escaped(HOSTILE), note_html(HOSTILE), rows_html([(HOSTILE,) * 2])]
)
def test_escaped_html_of_hostile_names(html: str) -> None:
    assert "<img" not in html
    assert "<script" not in html
    assert "&lt;img" in html
    assert "&amp;amp;" in html
    assert html.count("</td>") == html.count("<td")


def test_short_name_both_ends() -> None:
    name = "assembly/sub/" + "a very long name of a part, number " * 3 + "17"
    short = short_name(name, 34)
    assert len(short) == 34
    assert short.startswith("a very")
    assert short.endswith("17")
    assert short_name("body/door", 34) == "body/door"
    assert short_name("left/door", 6) == "door"


def test_sweep_colours_every_exit_status() -> None:
    assert set(COLOURS) == set(WORST)


def test_plain_name_one_line() -> None:
    assert plain_name("a\nb\x1b[31m\u202e") == "a?b?[31m?"
    assert plain_name("") == "(no name)"


NAMES = {
    4: "body/door/handle",
    2: "body/hood",
    9: "engine/piston 1",
    7: "body/door/glass",
    1: "jack",
}


def test_assemblies_of_descendants_in_order() -> None:
    found = assemblies_of(NAMES)
    assert list(found.items()) == [("body", [7, 4, 2]), ("body/door", [7, 4]), ("engine", [9])]


def test_found_ids_words_any_case_ranked() -> None:
    assert found_ids(NAMES, "DOOR") == [7, 4]
    assert found_ids(NAMES, "h") == [4, 2]
    assert found_ids(NAMES, "body gl") == [7]
    assert found_ids(NAMES, "  ") == []
    assert found_ids(NAMES, "piston 1") == [9]
