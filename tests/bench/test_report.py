"""The written evaluation states the cells' figures, recomputed here from made-up cells."""

import math
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticdb.bench.contests import contests
from hapticdb.bench.drawing.draw import draw
from hapticdb.bench.markdown import (
    bytes_text,
    count_text,
    listed,
    table,
    time_text,
    us_text,
)
from hapticdb.errors import FileError
from made_up import MAKERS, Cell, cell, everything
from report.findings import choices, repeats
from report.page import CHAPTERS, write_report
from report.plots import REPORT_KINDS
from report.reasons import (
    best_for_all,
    how_regions_differ,
    why_array_wins,
    why_loop_differs,
)

few = settings(max_examples=40, deadline=None)
times = st.floats(1.0, 1e6)
SQLITE, OLD, NEW = "SQLite 3.51.0", "PostgreSQL 15.18", "PostgreSQL 18.6"


def written(results: dict[str, Any], folder: Path) -> str:
    path = folder / "docs" / "evaluation.md"
    write_report(results, path, "../results")
    return path.read_text()


@pytest.fixture(scope="session")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    return written(everything(), tmp_path_factory.mktemp("report"))


def chapter(page: str, title: str) -> str:
    return re.split(r"^## ", page.split(f"\n## {title}")[1], flags=re.MULTILINE)[0]


def curve(engine: str, us_by_gap: dict[int, float], cbgroup: float, **own: Any) -> list[Cell]:  # noqa: ANN401
    base = {"engine": engine, "layout": "voxel", **own}
    cells = [cell(us, strategy="maxgap", maxgap=gap, **base) for gap, us in us_by_gap.items()]
    return [*cells, cell(cbgroup, strategy="cbgroup", **base)]


# --- the page -----------------------------------------------------------------------------------


def test_every_experiment_has_its_chapter_in_order(page: str) -> None:
    titles = re.findall(r"^## (.*)$", page, re.MULTILINE)
    expected = [one.title for one in CHAPTERS]
    expected.insert(-3, "`auto`: does the cost model choose well?")
    assert titles == ["How to read", *expected]
    assert {one.experiment for one in CHAPTERS} == set(MAKERS)


def test_every_picture_is_there_and_every_plot_is_shown(page: str, tmp_path: Path) -> None:
    shown = re.findall(r"^!\[[^]]+\]\(\.\./results/([^)]+)\)$", page, re.MULTILINE)
    assert sorted(shown) == sorted(path.name for path in draw(everything(), tmp_path, REPORT_KINDS))


def test_tables_are_whole(page: str) -> None:
    for block in re.findall(r"(?:^\|.*\|\n)+", page, re.MULTILINE):
        widths = {len(re.split(r"(?<!\\)\|", line)) for line in block.splitlines()}
        assert len(widths) == 1, block


def test_the_page_is_the_same_twice(page: str, tmp_path: Path) -> None:
    assert written(everything(), tmp_path) == page


def test_machine_versions_and_inputs_are_said_once_when_they_agree(
    page: str, tmp_path: Path
) -> None:
    assert page.count("| processor | made up |") == 1
    assert page.count("| hapticdb | commit 0123abc |") == 1
    assert "| PostgreSQL | 15.18, 18.6 |" in page
    assert "| seed | 20 |" in page
    apart = everything()
    apart["scale"]["machine"] = {"processor": "another"}
    again = written(apart, tmp_path)
    assert "Scale:\n\n|  |  |\n| --- | --- |\n| processor | another |" in again


def test_notes_and_experiments_that_were_not_run_are_named(page: str, tmp_path: Path) -> None:
    assert "- not measured: Apache Nowhere: not installed" in chapter(page, "Peers")
    results = everything()
    part = {name: results[name] for name in ("figure9", "tail")}
    part["scale"] = {"notes": ["not measured: disk full"], "cells": []}
    again = written(part, tmp_path)
    assert re.findall(r"^## (.*)$", again, re.MULTILINE) == [
        "How to read", "Figure 9: MaxGap against CBGroup", "The slowest frames",
        "`auto`: does the cost model choose well?", "Scale",
    ]  # fmt: skip
    assert "Not measured in this run: Table 1: environments, Figure 8" in again
    assert "- not measured: disk full" in again


def test_a_page_that_cannot_be_written_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "docs").write_text("")
    with pytest.raises(FileError, match=r"cannot write .*evaluation"):
        written({}, tmp_path)


def test_nothing_measured_is_a_page_too(tmp_path: Path) -> None:
    assert "Not measured in this run" in written({}, tmp_path)


# --- MaxGap and CBGroup -------------------------------------------------------------------------


@few
@given(
    us=st.dictionaries(st.integers(0, 10**6), times, min_size=1, max_size=8),
    cbgroup=times,
)
def test_the_best_maxgap_is_the_fastest_and_its_plateau_is_near(
    us: dict[int, float], cbgroup: float
) -> None:
    (found,) = contests(curve(SQLITE, us, cbgroup))
    best = min(us.values())
    assert us[found.best_maxgap] == best
    assert found.cbgroup_ratio == pytest.approx(cbgroup / best)
    assert found.is_close == (found.cbgroup_ratio <= 1.05)
    low, high = found.plateau
    assert low <= found.best_maxgap <= high
    assert all(time <= 1.05 * best for gap, time in us.items() if low <= gap <= high)


def test_cases_that_are_close_are_counted_and_the_others_listed(tmp_path: Path) -> None:
    cells = [
        *curve(SQLITE, {0: 300.0, 500: 100.0}, 104.0),
        *curve(OLD, {0: 300.0, 500: 100.0}, 99.0),
        *curve(NEW, {0: 300.0, 500: 100.0}, 112.0),
    ]
    page = written({"figure9": {"cells": cells}}, tmp_path)
    assert "in 2 of 3 cases, and faster than every MAXGAP in 1." in page
    listed_off = page.split("more than 5 % slower than the best MAXGAP:")[1].split("###")[0]
    assert listed_off.strip() == f"- {NEW}, voxels, one statement: 1.12"


def test_forms_are_held_against_their_own_kind() -> None:
    cells = [
        *curve(NEW, {0: 200.0, 100: 100.0}, 100.0),
        *curve(NEW, {0: 900.0, 100: 400.0}, 300.0, form="loop in the server"),
    ]
    assert [(c.form, c.cbgroup_ratio) for c in contests(cells)] == [
        ("one statement", 1.0), ("loop in the server", 0.75),
    ]  # fmt: skip


@pytest.mark.parametrize(("engine", "is_known"), [(NEW, True), (OLD, False), (SQLITE, False)])
def test_any_by_leaf_is_the_reason_from_version_17_on_and_where_array_wins(
    engine: str, *, is_known: bool
) -> None:
    cells = curve(engine, {0: 300.0, 500: 100.0}, 100.0)
    faster = cell(60.0, engine=engine, layout="voxel", strategy="array")
    (said,) = why_array_wins(contests([*cells, faster]))
    assert "`array` takes 0.60 of CBGroup's time" in said
    assert ("leaf page" in said) == is_known
    slower = cell(99.0, engine=engine, layout="voxel", strategy="array")
    assert why_array_wins(contests([*cells, slower])) == []


@few
@given(slope=st.floats(0.5, 100.0), ranges=st.lists(st.integers(1, 500), min_size=2, unique=True))
def test_what_a_range_costs_more_in_the_loop_is_found(slope: float, ranges: list[int]) -> None:
    one, looped = [], []
    base: Cell = {"engine": NEW, "layout": "voxel", "strategy": "maxgap"}
    for gap, n in enumerate(ranges):
        one.append(cell(50.0 + n, maxgap=gap, ranges=n, **base))
        slow = 80.0 + n + slope * n
        looped.append(cell(slow, maxgap=gap, ranges=n, form="loop in the server", **base))
    ends = [
        cell(60.0, **{**base, "strategy": "cbgroup", "form": form})
        for form in ("one statement", "loop in the server")
    ]
    (said,) = why_loop_differs(contests([*one, *looped, *ends]))
    told = re.search(r"a range costs ([\d.,]+) us more in the loop", said)
    assert told is not None
    assert float(told[1].replace(",", "")) == pytest.approx(slope, abs=0.051)


def test_a_loop_that_costs_no_more_gives_no_reason() -> None:
    cells = curve(NEW, {0: 300.0, 500: 100.0}, 100.0)
    for one, ranges in zip(cells, (200, 20, 30), strict=True):
        one["ranges"] = ranges
    same = [{**one, "form": "loop in the server"} for one in cells]
    assert why_loop_differs(contests([*cells, *same])) == []


def test_one_maxgap_for_all_regions_is_held_against_cbgroup() -> None:
    low = curve(SQLITE, {0: 100.0, 500: 150.0, 5000: 50.0}, 51.0, region="low")
    high = curve(SQLITE, {0: 40.0, 500: 42.0, 5000: 90.0}, 41.0, region="high")
    found = contests([*low, *high])
    assert best_for_all(found) == (0, 2.0)
    (said,) = how_regions_differ(found)
    assert "5,000 (low) and 0 (high)" in said
    assert "CBGroup up to 1.02: it adapts to the density" in said
    behind = [*low[:-1], cell(130.0, **{**low[-1], "us": None} | {"us": low[1]["us"]})]
    assert "adapts to the density" not in how_regions_differ(contests([*behind, *high]))[0]


# --- auto ---------------------------------------------------------------------------------------


@few
@given(
    us=st.dictionaries(
        st.sampled_from(["array", "cbgroup", "maxgap", "points"]), times, min_size=1
    ),
    auto=times,
)
def test_auto_is_held_against_the_fastest_beside_it(us: dict[str, float], auto: float) -> None:
    base: Cell = {"engine": SQLITE, "layout": "brick"}
    cells = [cell(value, strategy=name, **base) for name, value in {**us, "auto": auto}.items()]
    # another group, with which `auto` must not be compared
    cells.append(cell(0.1, strategy="array", **{**base, "layout": "voxel"}))
    (found,) = choices({"strategies": {"cells": cells}})
    assert found.ratio == pytest.approx(auto / min(us.values()))
    own = [value for name, value in us.items() if name != "maxgap"]
    assert found.choosable_ratio == (pytest.approx(auto / min(own)) if own else None)


def test_auto_is_counted_and_its_worst_groups_are_shown(tmp_path: Path) -> None:
    base: Cell = {"engine": SQLITE, "layout": "brick"}
    cells = []
    for n, auto in ((300, 105.0), (1000, 130.0)):
        cells.append(cell(100.0, strategy="array", points=n, **base))
        chosen = {"cbgroup": 75, "array": 25}
        cells.append(cell(auto, strategy="auto", points=n, chosen=chosen, **base))
    page = written({"points": {"cells": cells}}, tmp_path)
    assert "within 10 % of the fastest strategy, or faster, in 1 of 2 groups" in page
    assert (
        f"| points | {SQLITE}, bricks, 1,000 points | 130 | cbgroup 75 %, array 25 % | array "
        "| 100 | 1.30 |" in page
    )


def test_a_loop_in_the_server_is_no_strategy_to_choose() -> None:
    base: Cell = {"engine": NEW, "layout": "brick"}
    cells = [
        cell(100.0, strategy="auto", **base),
        cell(10.0, strategy="cbgroup", form="loop in the server", **base),
        cell(90.0, strategy="array", **base),
    ]
    (found,) = choices({"figure9": {"cells": cells}})
    assert found.best["strategy"] == "array"


# --- the others ---------------------------------------------------------------------------------


def test_peers_are_sorted_and_compared_at_the_same_question(page: str) -> None:
    text = chapter(page, "Peers")
    p50 = [
        float(us.replace(",", ""))
        for us in re.findall(r"^\| [^|]+ \| [^|]+ \| ([\d.,]+) \|", text, re.MULTILINE)
    ]
    assert p50 == sorted(p50)
    assert len(p50) == 9
    assert "dense bitmap (0.04), NumPy searchsorted (0.36) and Python set (0.86)." in text
    assert "Hits differ" not in text
    sentences = [line for line in text.splitlines() if line.startswith("- ")]
    assert not any("coal" in line or "Open3D" in line for line in sentences)


def test_a_peer_with_other_hits_is_named_and_never_rounded_to_all(tmp_path: Path) -> None:
    off = cell(5.0, peer="Odd", question="the same hits", hits_agree=0.99999)
    page = written({"peers": {"cells": [off]}}, tmp_path)
    assert "Hits differ at some poses, though the question is the same: Odd (99.99 %)." in page


def test_scale_says_how_time_grows(page: str) -> None:
    text = chapter(page, "Scale")
    assert (
        f"{SQLITE}, slide poses: 1,000 times the voxels take 1.00 times the time a frame." in text
    )
    assert "random poses: 1,000 times the voxels take 2.20 times the time a frame." in text


def test_caches_layouts_and_curves_are_compared_pair_by_pair(page: str) -> None:
    assert "out of the operating system's cache a frame takes 14.00 the time" in chapter(
        page, "Caches"
    )
    text = chapter(page, "Curves and layouts")
    assert "On bricks instead of voxels a frame takes 0.45 the time (18 pairs" in text
    assert "lexicographic order instead a frame takes 1.70 the time (9 pairs" in text


@few
@given(
    experiment=st.sampled_from(sorted(MAKERS)),
    key=st.sampled_from(sorted({key for make in MAKERS.values() for one in make() for key in one})),
    value=st.sampled_from([None, 0, math.nan, ""]),
    data=st.data(),
)
def test_whatever_a_cell_lacks_the_page_is_written(
    tmp_path_factory: pytest.TempPathFactory,
    experiment: str,
    key: str,
    value: object,
    data: st.DataObject,
) -> None:
    cells = [dict(one) for one in MAKERS[experiment]()]
    for one in data.draw(st.lists(st.sampled_from(cells), max_size=40)):
        one[key] = value if not isinstance(one.get(key), str | dict) else None
    page = written({experiment: {"cells": cells}}, tmp_path_factory.mktemp("lacks"))
    assert not re.search(r"\b(nan|None|inf)\b", page)


def test_numbers_keep_three_digits() -> None:
    assert [us_text(us) for us in (None, 2.94, 9.96, 43.21, 99.6, 1076.4)] == [
        "-", "2.9", "10.0", "43.2", "100", "1,076",
    ]  # fmt: skip
    assert [count_text(n) for n in (None, 0.0, 10.7, 1e6)] == ["-", "0", "10.7", "1,000,000"]
    assert [bytes_text(n) for n in (None, 12, 31_457_280, 2.5e9)] == [
        "-",
        "12 bytes",
        "31.5 MB",
        "2.5 GB",
    ]
    assert time_text(cell(100.0, frames=10)) == "100*"


def test_a_table_escapes_what_would_break_it() -> None:
    assert table(["a"], [["x | y\nz"]]) == "| a |\n| --- |\n| x \\| y z |"
    assert table(["a"], []) == ""
    assert [listed(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == [
        "", "a", "a and b", "a, b and c",
    ]  # fmt: skip


def test_what_was_measured_twice_tells_how_far_to_trust_the_rest() -> None:
    alike = cell(100.0, engine=SQLITE, layout="brick", strategy="array")
    again = cell(125.0, engine=SQLITE, layout="brick", strategy="array")
    other = cell(900.0, engine=SQLITE, layout="voxel", strategy="array")
    results = {
        name: {"name": name, "cells": cells}
        for name, cells in (("figure9", [alike, other]), ("conditions", [again]))
    }
    assert repeats(results) == [1.25]
    assert repeats({"figure9": results["figure9"]}) == []


def test_a_ratio_is_told_beside_what_the_choices_alone_explain() -> None:
    base: Cell = {"engine": SQLITE, "layout": "brick"}
    cells = [
        cell(150.0, strategy="auto", chosen={"array": 750, "cbgroup": 250}, **base),
        cell(100.0, strategy="array", **base),
        cell(140.0, strategy="cbgroup", **base),
    ]
    (found,) = choices({"strategies": {"name": "strategies", "cells": cells}})
    assert found.ratio == pytest.approx(1.5)
    assert found.explained == pytest.approx(1.1)
    cells[0]["cut_short"] = True
    assert choices({"strategies": {"name": "strategies", "cells": cells}}) == []


def test_the_fitted_costs_are_told_beside_what_a_range_is_worth(page: str) -> None:
    told = chapter(page, "What the grouping stands on")
    assert "| SQLite 3.51.0, bricks | 40 | 0.6 | 0.4 | 38 | 0.3 | 2 | 0.75 |" in told
    assert (
        "SQLite 3.51.0, bricks: a range more costs as much as 1.5 rows, and 2.0 times a key" in told
    )
