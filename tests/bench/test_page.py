"""The page of `hapticdb bench` has its own plots and tables, and none of the evaluation's."""

import re
from pathlib import Path
from typing import Any

import pytest

from hapticdb.bench.drawing.draw import draw
from hapticdb.bench.page import SECTIONS, write_bench_page
from hapticdb.errors import FileError
from made_up import everything

OURS = {one.experiment for one in SECTIONS}


def written(results: dict[str, Any], folder: Path) -> str:
    write_bench_page(results, folder / "evaluation.md")
    return (folder / "evaluation.md").read_text()


def own_results() -> dict[str, Any]:
    """The part of the made-up evaluation that `hapticdb bench` measures of one environment."""
    found = {name: one for name, one in everything().items() if name in {"table1", *OURS}}
    cell = {
        "environment": "car",
        "engine": "SQLite 3.51.0",
        "layout": "voxel",
        "objects": 217,
        "object_voxels": 13_500_792,
        "bits": 11,
        "edge": 1.6,
        "voxel_size": 1.6 / 2048,
        "rows_voxel": 13_500_792,
        "bytes_voxel": 512_000_000,
    }
    found["table1"]["cells"] = [cell]
    return found


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    return written(own_results(), tmp_path_factory.mktemp("page"))


def test_the_page_has_a_section_for_each_experiment(page: str) -> None:
    titles = re.findall(r"^## (.*)$", page, re.MULTILINE)
    assert titles == [*(one.title for one in SECTIONS), "How to read"]
    for one in SECTIONS:
        text = page.split(f"## {one.title}\n")[1].split("\n## ", maxsplit=1)[0]
        assert one.asked in text
        assert re.search(r"^\| --- \|.*---: \|$", text, re.MULTILINE), one.title


def test_the_page_shows_every_plot_and_no_other(page: str, tmp_path: Path) -> None:
    shown = re.findall(r"^!\[[^]]+\]\(([^)]+)\)$", page, re.MULTILINE)
    assert sorted(shown) == sorted(path.name for path in draw(own_results(), tmp_path))


def test_the_page_says_what_the_environment_is(page: str) -> None:
    facts = dict(
        re.findall(r"^\| ([\w ]+) \| (.+) \|$", page.split("\n## ", maxsplit=1)[0], re.MULTILINE)
    )
    assert page.startswith("# Frames on car\n")
    assert facts == {
        "engine": "SQLite 3.51.0",
        "layout": "voxels",
        "objects": "217",
        "object voxels": "13,500,792",
        "rows": "13,500,792",
        "size": "512 MB",
        "bits an axis": "11",
        "voxel size": "0.7812 mm",
        "edge of the grid": "1.6 m",
    }


def test_the_page_tells_nothing_of_what_bench_does_not_measure(page: str) -> None:
    assert not re.search(r"peers|Voxelizing|Scale|Not measured in this run", page)


def test_an_experiment_without_cells_has_no_section(tmp_path: Path) -> None:
    part = {name: one for name, one in own_results().items() if name in {"table1", "tail"}}
    titles = re.findall(r"^## (.*)$", written(part, tmp_path), re.MULTILINE)
    assert titles == ["The slowest frames", "How to read"]


def test_a_page_that_cannot_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(FileError, match=r"cannot write .*evaluation"):
        written({}, tmp_path / "taken")
