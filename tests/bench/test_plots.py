"""Plots of made-up results: each is drawn, names its conditions, and is reproducible."""

import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticdb.bench.cells import ORDERS, distinct, grouped
from hapticdb.bench.drawing.canvas import count, duration, log_ticks
from hapticdb.bench.drawing.draw import KINDS, draw
from hapticdb.bench.drawing.paper_plots import gap_places
from hapticdb.bench.drawing.plots import plots_among
from hapticdb.errors import FileError
from made_up import MAKERS, Cell, cell, everything
from report.plots import REPORT_KINDS

FILES = {
    "figure8",
    "figure9",
    "figure9-all-cached",
    "figure9-rows",
    "figure10",
    "conditions",
    "strategies",
    "strategies-random",
    "strategies-recorded-wrench",
    "layouts",
    "points",
    "tail",
    "peers",
    "voxelizing",
    "scale",
}
few = settings(max_examples=25, deadline=None)


@pytest.fixture(scope="session")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("plots")
    return {path.stem: path for path in draw(everything(), folder, REPORT_KINDS)}


def words_of(path: Path) -> str:
    """All text of an SVG."""
    texts = (node for node in ET.fromstring(path.read_text()).iter() if node.tag.endswith("text"))  # noqa: S314 - our own file
    return "\n".join("".join(node.itertext()) for node in texts)


def result(*cells: Cell) -> dict[str, Any]:
    return {"cells": list(cells)}


def test_every_experiment_but_the_tables_is_drawn(drawn: dict[str, Path]) -> None:
    assert set(drawn) == FILES
    assert {kind.experiment for kind in REPORT_KINDS} == set(MAKERS) - {"table1", "costs"}


def test_bench_draws_no_experiment_of_the_evaluation_alone(tmp_path: Path) -> None:
    ours = {path.stem for path in draw(everything(), tmp_path)}
    assert ours == FILES - {"layouts", "peers", "voxelizing", "scale"}
    assert REPORT_KINDS[: len(KINDS)] == KINDS


def test_pictures_are_small_and_hold_text(drawn: dict[str, Path]) -> None:
    for path in drawn.values():
        assert path.stat().st_size < 150_000, path.name
        assert "Figure" in words_of(path) or len(words_of(path)) > 50


def test_the_same_results_give_the_same_bytes(drawn: dict[str, Path], tmp_path: Path) -> None:
    for path in draw(everything(), tmp_path / "deep" / "again", REPORT_KINDS):
        assert path.read_bytes() == drawn[path.stem].read_bytes()
        assert not re.search(r"<dc:date>", path.read_text())


def test_a_plot_says_its_conditions(drawn: dict[str, Path]) -> None:
    said = words_of(drawn["figure9"])
    for condition in (
        "300 points",
        "slide over surfaces",
        "Z-order",
        "10,000 quantiles",
        "database cache 4 MB",
        "file in the operating system's cache",
        "220 to 1,000 frames a cell",
        "one session",
        "SQLite 3.51.0",
        "PostgreSQL 15.18",
        "PostgreSQL 18.6",
    ):
        assert condition in said
    assert "database cache all cached" in words_of(drawn["figure9-all-cached"])
    assert "the recorded path" in words_of(drawn["strategies-recorded-wrench"])


def test_cells_that_were_cut_short_are_hollow_and_said_to_be(
    drawn: dict[str, Path], tmp_path: Path
) -> None:
    def hollow(path: Path) -> int:
        return len(re.findall(r"fill: #ffffff; stroke: #009e73", path.read_text()))

    assert "Hollow marks" in words_of(drawn["figure9"])
    assert hollow(drawn["figure9"]) > 0
    whole = everything()
    for one in whole["figure9"]["cells"]:
        one["cut_short"] = False
    path = next(path for path in draw(whole, tmp_path) if path.stem == "figure9")
    assert "Hollow marks" not in words_of(path)
    assert hollow(path) == 0


def test_the_slowest_in_a_thousand_need_ten_thousand_frames(
    drawn: dict[str, Path], tmp_path: Path
) -> None:
    assert "p99.9" in words_of(drawn["tail"])
    short = [
        cell(100.0, engine="SQLite 3.51.0", layout="brick", strategy=name)
        for name in ("array", "auto")
    ]
    (path,) = draw({"tail": result(*short)}, tmp_path)
    assert "p99.9 is left out below 10,000 frames" in words_of(path)
    assert "4,762 /s" in words_of(path)


def test_figure_10_gives_the_density_of_each_region(drawn: dict[str, Path]) -> None:
    said = words_of(drawn["figure10"])
    assert [said.index(f"{region} density") for region in ("low", "middle", "high")] == sorted(
        said.index(f"{region} density") for region in ("low", "middle", "high")
    )
    assert "0.6 % occupied" in said


def test_one_engine_and_one_layout_are_enough(tmp_path: Path) -> None:
    cut = everything()
    for one in cut.values():
        one["cells"] = [
            c
            for c in one["cells"]
            if c.get("engine", "SQLite 3.51.0") == "SQLite 3.51.0"
            and c.get("layout", "brick") == "brick"
        ]
    assert {path.stem for path in draw(cut, tmp_path, REPORT_KINDS)} == FILES


def test_a_panel_without_cells_says_so(tmp_path: Path) -> None:
    cells = [
        cell(100.0, engine="SQLite 3.51.0", layout="brick", strategy="array"),
        cell(100.0, engine="PostgreSQL 18.6", layout="voxel", strategy="array"),
    ]
    (path,) = draw({"strategies": result(*cells)}, tmp_path)
    assert words_of(path).count("not measured") == 2


def test_nothing_is_drawn_of_nothing(tmp_path: Path) -> None:
    assert draw({}, tmp_path, REPORT_KINDS) == []
    empty = {
        "figure9": {},
        "tail": result(),
        "peers": {"cells": None},
        "another": result({"us": 3}),
    }
    assert draw(empty, tmp_path, REPORT_KINDS) == []


def test_a_name_with_a_dollar_sign_is_a_name(tmp_path: Path) -> None:
    odd = cell(9.0, environment="a $b_{ & <c>", engine="SQLite", layout="brick", strategy="array")
    (path,) = draw({"strategies": result(odd)}, tmp_path)
    assert "environment a $b_{ & <c>" in words_of(path)


def test_plots_of_several_environments_have_names_of_their_own() -> None:
    names = ("car", "Käfer/1", "Käfer 1", "kafer-1")
    cells = [
        cell(9.0, environment=name, engine="SQLite", layout="brick", strategy="array")
        for name in names
    ]
    found = [plot.name for plot in plots_among({"tail": result(*cells)}, KINDS)]
    assert len(set(found)) == 4
    assert "tail" in found
    assert all(re.fullmatch(r"[a-z0-9-]+", name) for name in found)


def test_the_paper_conditions_keep_the_plain_name() -> None:
    for plot in plots_among(everything(), KINDS):
        caches = {one.get("cache") for one in plot.cells}
        if plot.name in {"figure8", "figure9", "figure10"}:
            assert caches == {"4 MB"}


def test_a_file_that_cannot_be_written_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match=r"cannot write .*figure8"):
        draw({"figure8": everything()["figure8"]}, tmp_path / "file")


# --- cells that lack fields ---------------------------------------------------------------------

LACKS = st.sampled_from(
    ["us", "engine", "layout", "cache", "poses", "points", "maxgap", "rows", "false_rows", "ranges",
     "frames", "strategy", "grouping_us", "region", "density", "resolution", "environment",
     "object_voxels", "bytes_per_voxel", "peer", "question", "voxels_per_second", "tool", "curve"]
)  # fmt: skip
VALUES = st.sampled_from([None, 0, math.nan])


@few
@given(
    experiment=st.sampled_from(sorted(set(MAKERS) - {"table1"})),
    key=LACKS,
    value=VALUES,
    data=st.data(),
)
def test_missing_numbers_are_passed_over(
    tmp_path_factory: pytest.TempPathFactory,
    experiment: str,
    key: str,
    value: float | None,
    data: st.DataObject,
) -> None:
    cells = [dict(one) for one in MAKERS[experiment]()][:24]
    for one in data.draw(st.lists(st.sampled_from(cells), max_size=24)):
        if key in {"us", "engine", "layout", "strategy"} or isinstance(one.get(key), str):
            one[key] = None
        elif key in one:
            one[key] = value
    folder = tmp_path_factory.mktemp("lacks")
    for path in draw({experiment: result(*cells)}, folder, REPORT_KINDS):
        assert words_of(path)


@given(low=st.floats(0.01, 1e6), factor=st.floats(4.0, 1e6))
def test_a_logarithmic_axis_has_ticks_within_its_limits(low: float, factor: float) -> None:
    ticks = log_ticks(low, low * factor)
    assert 2 <= len(ticks) <= 12
    assert all(low <= tick <= low * factor for tick in ticks)
    assert ticks == sorted(set(ticks))


@given(st.lists(st.integers(0, 10**7), min_size=1, max_size=12, unique=True).map(sorted))
def test_gaps_stand_in_their_order_with_zero_before_all(gaps: list[int]) -> None:
    place, ticks, names = gap_places([{"maxgap": gap} for gap in gaps])
    at = [place(gap) for gap in gaps]
    assert at == sorted(set(at))
    assert all(ticks[0] <= x <= ticks[-1] for x in at)
    assert names[0] == "0"
    assert all(place(0) < place(gap) for gap in gaps if gap)


def test_ticks_are_written_in_the_shortest_unit() -> None:
    assert [duration(us) for us in (0.5, 30, 1000, 20_000, 3e6)] == [
        "0.5 us", "30 us", "1 ms", "20 ms", "3 s",
    ]  # fmt: skip
    assert [count(n) for n in (1, 300, 1000, 13_512_345, 1.4e9)] == [
        "1",
        "300",
        "1k",
        "13.5M",
        "1.4G",
    ]


def test_engines_stand_by_version_with_sqlite_first() -> None:
    names = ["PostgreSQL 18.6", "PostgreSQL 9.6", "SQLite 3.51.0", "PostgreSQL 15.18"]
    assert distinct([{"engine": name} for name in names], "engine") == [
        "SQLite 3.51.0", "PostgreSQL 9.6", "PostgreSQL 15.18", "PostgreSQL 18.6",
    ]  # fmt: skip


@given(st.lists(st.fixed_dictionaries({}, optional={
    "strategy": st.sampled_from([*ORDERS["strategy"], "mine"]),
    "points": st.integers(1, 1000),
})))  # fmt: skip
def test_grouping_cells_loses_none(cells: list[dict[str, Any]]) -> None:
    groups = grouped(cells, ("strategy", "points"))
    assert sum(map(len, groups.values())) == len(cells)
    for (strategy, points), group in groups.items():
        assert all(one.get("strategy") == strategy and one.get("points") == points for one in group)
    strategies = [strategy for strategy, _ in groups]
    order = [*distinct(cells, "strategy"), None]
    assert strategies == sorted(strategies, key=order.index)
