"""The listing of objects: filtered, cut where a terminal shows it, in columns."""

import json
import re
from pathlib import Path

import pytest

from assemblies import box, write_obj
from command_line import Run, on_terminal, refused, succeeded
from hapticdb.cli import main, render
from hapticdb.cli.verbs.listing import PAGE

N_BOLTS = 60


@pytest.fixture(scope="module")
def bolts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """60 bolts along x, 0.1 m apart, and a plate."""
    folder = tmp_path_factory.mktemp("bolts")
    names = [*(f"frame/bolt_{n}" for n in range(N_BOLTS)), "plate"]
    parts = {
        name: box((0.1 * n, 0, 0), (0.1 * n + 0.05, 0.01, 0.01)) for n, name in enumerate(names)
    }
    file = write_obj(folder / "bolts.obj", parts)
    assert main(["import", str(folder / "b.db"), str(file), "--bits", "7"]) == 0
    return folder / "b.db"


def listed(run: Run, url: Path, *words: object) -> list[str]:
    out = succeeded(run("objects", url, "--json", *words))
    return [json.loads(line)["name"] for line in out.splitlines()]


def test_objects_selection_by_name_pattern_id(run: Run, bolts: Path) -> None:
    assert listed(run, bolts, "--name", "bolt_5?", "--name", "plate,1") == [
        "frame/bolt_0", *(f"frame/bolt_5{n}" for n in range(10)), "plate",
    ]  # fmt: skip
    assert len(listed(run, bolts, "--name", "frame")) == N_BOLTS
    refused(run("objects", bolts, "--name", "nut*"), "--name: no object 'nut*'")


def test_objects_limit(run: Run, bolts: Path) -> None:
    assert listed(run, bolts, "--limit", 2) == ["frame/bolt_0", "frame/bolt_1"]
    whole = succeeded(run("objects", bolts))
    assert (len(whole.splitlines()), "\x1b" in whole) == (2 + N_BOLTS + 1, False)
    assert len(listed(run, bolts)) == len(listed(run, bolts, "--limit", 0)) == N_BOLTS + 1
    code, out, err = run("objects", bolts, "--limit", 50)
    assert (code, err) == (0, "hapticdb: 50 of 61 objects; --limit 0 shows all\n")
    assert len(out.splitlines()) == 52
    refused(run("objects", bolts, "--limit", -1), "--limit")


def test_objects_terminal_page_limit(bolts: Path) -> None:
    *lines, last = on_terminal("objects", bolts).splitlines()
    assert last == f"hapticdb: {PAGE} of 61 objects; --limit 0 shows all"
    text = "".join(lines)
    assert "bolt_39" in text
    assert "bolt_40" not in text


def test_objects_table_fits_terminal(bolts: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "52")
    lines = on_terminal("objects", bolts, "--limit", 3).splitlines()[:-1]
    assert max(map(len, lines)) <= 52
    monkeypatch.setenv("COLUMNS", "26")
    lines = on_terminal("objects", bolts, "--limit", 2).splitlines()
    assert max(map(len, lines[:-1])) <= 26
    assert [line.split()[:2] for line in lines[:2]] == [["id", "1"], ["name", "frame/bolt_0"]]
    monkeypatch.setenv("COLUMNS", "40")
    shown = on_terminal("info", bolts)
    assert max(map(len, shown.splitlines())) <= 40
    assert re.search(r"scene +.*\n +\S", shown)  # goes on below its beginning


def test_check_verdict_colour(bolts: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "\x1b[32m" in on_terminal("check", bolts)
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\x1b[3" not in on_terminal("check", bolts).rpartition("\x1b[2K")[2]


# -- columns --------------------------------------------------------------------------------------


def test_table_column_alignment(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [("1", "short", "10"), ("12", "a somewhat longer text", "9,000"), ("3", "部品", "")]
    with monkeypatch.context() as patch:
        patch.setattr(render, "_room", lambda: 24)
        render.table(("id>", "name", "n>", "where?"), [(*row, "far") for row in rows])
        _, _, _, line, _ = capsys.readouterr().out.splitlines()
        assert line == " 12 a so…ger text 9,000"
    render.table(("id>", "name", "n>"), rows)
    assert capsys.readouterr().out.splitlines() == [
        " id   name                         n",
        "─" * 37,
        "  1   short                       10",
        " 12   a somewhat longer text   9,000",
        "  3   部品",
    ]
    render.facts([("on 部品", "1"), ("on \x1b[2J", "2")])
    assert capsys.readouterr().out.splitlines() == ["on 部品     1", "on \\x1b[2J  2"]
