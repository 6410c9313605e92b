"""The listing of objects: filtered, sorted, in pages, as wide as the terminal."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import fcntl
import json
import os
import pty
import struct
import termios
from pathlib import Path

import pytest
import trimesh

from children import child
from command_line import Run, command, made, refused, run, scene  # noqa: F401 - fixtures
from hapticdb.cli import main
from hapticdb.cli.columns import Columns, folded, width_of
from hapticdb.cli.pages import PAGE

N_BOLTS = 60


@pytest.fixture(scope="module")
def bolts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """60 bolts along x, 0.1 m apart, each shorter than the last, bolt 7 longest; and a plate."""
    folder = tmp_path_factory.mktemp("bolts")
    lines: list[str] = []
    sizes = [0.05 - 0.0005 * n for n in range(N_BOLTS)]
    sizes[7] = 0.06
    names = [f"frame/bolt_{n}" for n in range(N_BOLTS)]
    for n, (name, size) in enumerate([*zip(names, sizes, strict=True), ("plate", 0.09)]):
        box = trimesh.creation.box((size, 0.01, 0.01))
        lines.append(f"o {name}")
        lines += [f"v {x + 0.1 * n} {y} {z}" for x, y, z in box.vertices]
        lines += ["f " + " ".join(str(v + 8 * n + 1) for v in face) for face in box.faces]
    (folder / "bolts.obj").write_text("\n".join([*lines, ""]))
    assert main(["import", str(folder / "b.db"), str(folder / "bolts.obj"), "--bits", "7"]) == 0
    return folder / "b.db"


def listed(run: Run, url: Path, *words: object) -> list[str]:
    code, out, err = run("objects", url, "--json", *words)
    assert (code, err) == (0, "")
    return [json.loads(line)["name"] for line in out.splitlines()]


def test_names_patterns_and_ids_choose(run: Run, bolts: Path) -> None:
    assert listed(run, bolts, "--name", "bolt_5?", "--name", "plate,1") == [
        "frame/bolt_0", *(f"frame/bolt_5{n}" for n in range(10)), "plate",
    ]  # fmt: skip
    assert len(listed(run, bolts, "--name", "frame")) == N_BOLTS
    refused(run("objects", bolts, "--name", "nut*"), "--name: no object 'nut*'")


def test_a_box_chooses_by_bounds(run: Run, bolts: Path) -> None:
    near = [0.12, -1, -1, 0.31, 1, 1]
    assert listed(run, bolts, "--box", *near) == ["frame/bolt_1", "frame/bolt_2", "frame/bolt_3"]
    assert listed(run, bolts, "--box", *near, "--name", "*_2") == ["frame/bolt_2"]
    assert len(listed(run, bolts, "--box", *["-inf"] * 3, *["inf"] * 3)) == N_BOLTS + 1
    code, out, err = run("objects", bolts, "--box", 9, 9, 9, 9, 9, 9)
    assert (code, out) == (0, "")
    assert "no object meets the box" in err
    refused(run("objects", bolts, "--box", 1, 0, 0, 0, 1, 1), "the lower corner first")
    refused(run("objects", bolts, "--box", "nan", 0, 0, 1, 1, 1), "--box")
    refused(run("objects", bolts, "--box", 0, 0, 1), "--box")


def test_objects_are_sorted_as_asked(run: Run, bolts: Path) -> None:
    by_name = [*(f"frame/bolt_{n}" for n in range(N_BOLTS)), "plate"]
    assert listed(run, bolts, "--sort", "name") == by_name  # 10 sorts after 9
    assert listed(run, bolts, "--sort", "name", "--reverse") == by_name[::-1]
    assert listed(run, bolts, "--sort", "id", "--reverse", "--limit", 1) == ["plate"]
    by_size = listed(run, bolts, "--sort", "size")
    assert by_size[:3] == ["plate", "frame/bolt_7", "frame/bolt_0"]
    assert by_size[-1] == f"frame/bolt_{N_BOLTS - 1}"
    lines = run("objects", bolts, "--json", "--sort", "voxels")[1].splitlines()
    voxels = [json.loads(line)["voxels"] for line in lines]
    assert voxels == sorted(voxels, reverse=True)


def test_pages_are_shown_when_asked_for(run: Run, bolts: Path) -> None:
    assert len(listed(run, bolts)) == N_BOLTS + 1
    assert listed(run, bolts, "--limit", 2, "--page", 3) == ["frame/bolt_4", "frame/bolt_5"]
    assert len(listed(run, bolts, "--page", 2)) == N_BOLTS + 1 - PAGE
    code, out, err = run("objects", bolts, "--limit", 50)
    assert (code, err) == (
        0, "hapticdb: objects 1 to 50 of 61; --page 2 goes on, --limit 0 shows all\n",
    )  # fmt: skip
    assert len(out.splitlines()) == 52
    assert "--page 3" not in run("objects", bolts, "--limit", 50, "--page", 2)[2]
    refused(run("objects", bolts, "--page", 3), "--page 3: the last page of 61 objects is 2")
    refused(run("objects", bolts, "--page", 0), "--page 0")
    refused(run("objects", bolts, "--limit", -1), "--limit -1")
    refused(run("objects", bolts, "--limit", 0, "--page", 2), "leave --page out")


def test_a_pipe_has_every_object_in_whole_lines(run: Run, bolts: Path) -> None:
    code, out, err = run("objects", bolts)
    assert (code, err) == (0, "")
    assert len(out.splitlines()) == 2 + N_BOLTS + 1
    assert "\x1b" not in out


@pytest.mark.parametrize("columns", [60, 80, 200])
def test_a_terminal_has_a_page_that_fits_it(bolts: Path, columns: int) -> None:
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    terminal = {k: v for k, v in os.environ.items() if k != "COLUMNS"} | {"TERM": "dumb"}
    with child(command("objects", bolts), stdout=theirs, stderr=theirs, env=terminal) as listing:
        os.close(theirs)
        seen = b""
        while chunk := _read(ours):
            seen += chunk
    os.close(ours)
    assert listing.returncode == 0
    *lines, last = seen.decode().splitlines()
    assert last == f"hapticdb: objects 1 to {PAGE} of 61; --page 2 goes on, --limit 0 shows all"
    assert max(map(len, lines)) <= columns
    text = "".join(lines)
    assert "bolt_39" in text
    assert "bolt_40" not in text


def _read(ours: int) -> bytes:
    try:
        return os.read(ours, 4096)
    except OSError:
        return b""


# -- columns --------------------------------------------------------------------------------------


def test_columns_stand_below_their_headings() -> None:
    rows = [("1", "short", "10"), ("12", "a somewhat longer text", "9,000")]
    columns = Columns(rows, ("id", "name", "n"), frozenset({0, 2}))
    assert columns.lines(None, is_styled=False) == [
        " id   name                         n",
        "─" * 37,
        "  1   short                       10",
        " 12   a somewhat longer text   9,000",
    ]


@pytest.mark.parametrize("width", [32, 40, 60])
def test_texts_are_folded_and_nothing_is_lost(width: int) -> None:
    long, wide = "assembly/" * 9, "部品" * 20
    rows = [("1", long, "a file.glb"), ("2", wide, "x")]
    lines = Columns(rows, ("id", "name", "file"), frozenset({0})).lines(width, is_styled=False)
    assert max(map(width_of, lines)) <= width
    pressed = "".join("".join(lines).split())
    assert pressed.count("assembly") + pressed.count("部") >= 20
    assert "".join(folded(long, 10)) == long
    assert "".join(folded(wide, 10)) == wide
    assert all(width_of(line) <= 10 for line in folded(wide, 10))


def test_styles_take_no_columns() -> None:
    plain = Columns([("a", "b")], ("x", "y")).lines(None, is_styled=False)
    styled = Columns([("a", "b")], ("x", "y")).lines(None, is_styled=True)
    assert [line.replace("\x1b[1m", "").replace("\x1b[0m", "") for line in styled] == plain
    assert styled != plain
