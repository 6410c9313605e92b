"""The verbs copy and diff, with right and wrong arguments."""

import json
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from command_line import Run, on_terminal, refused, succeeded
from hapticdb import Grid
from hapticdb.cli import render
from hapticdb.store.base import Object, Rows
from hapticdb.store.sqlite.tables.file_tables import FileTables
from voxels import write_voxels

# -- copy -----------------------------------------------------------------------------------------


def test_copy_reports_and_equals_source(run: Run, scene: Path) -> None:
    code, out, err = run("copy", scene, "b.db", "--layout", "voxel", "--curve", "hilbert")
    assert code == 0
    assert err == ("hapticdb: the layout voxel has no distances: it has the law plane alone\n")
    assert out.startswith("b.db: 3 objects copied, ")
    found = json.loads(run("info", "b.db", "--json")[1])
    assert (found["layout"], found["curve"], found["objects"]) == ("voxel", "hilbert", 3)
    out = succeeded(run("diff", scene, "b.db"))
    size = f"{found['voxel_size'] * 1000:.4g} mm"
    assert out == (
        f"{scene} and b.db hold the same: 3 objects, {found['voxels']:,} voxels, "
        f"64^3 cells of {size}; distances of 3 objects in A, of 0 in B\n"
    )


def test_copy_json_counts(run: Run, scene: Path) -> None:
    found = json.loads(succeeded(run("copy", scene, "b.db", "--json")))
    assert (found["copied"], found["present"], found["renumbered"]) == (3, 0, 0)


# -- diff -----------------------------------------------------------------------------------------


def test_diff_line_per_difference(run: Run, scene: Path) -> None:
    assert run("copy", scene, "b.db", "--layout", "voxel")[0] == 0
    assert run("diff", scene, "b.db")[0] == 0
    assert run("move", "b.db", 2, "--translate", "0,0,0.01")[0] == 0
    assert run("remove", "b.db", 3)[0] == 0
    with hapticdb.open("b.db") as env:
        link = env.object(1).link
    code, out, err = run("diff", scene, "b.db")
    assert (code, err) == (1, "")
    head, _, gone, moved, sides, total = out.splitlines()
    assert head.split()[:2] == ["id", "name"]
    assert gone.split() == ["3", "box2", "only", "in", "A", link]
    assert moved.split()[:4] == ["2", "box1", "another", "place"]
    assert "10 mm (0.8 voxels)" in moved
    assert (sides, total) == (f"A: {scene}; B: b.db", "2 differences")
    code, out, _ = run("diff", scene, "b.db", "--json")
    found = json.loads(out)
    assert code == 1
    assert (found["is_equal"], found["is_same_grid"], found["objects"]) == (False, True, 1)
    gone, record = found["differences"]
    assert gone == {"what": "only in A", "id": 3, "name": "box2", "link": link}
    assert (record["what"], record["id"]) == ("another place", 2)
    np.testing.assert_allclose(record["moved_by"], [0, 0, 0.01], atol=1e-12)
    assert record["farthest_corner"] == pytest.approx(0.01)


def test_diff_truncated_and_counted(run: Run, scene: Path) -> None:
    assert run("copy", scene, "b.db")[0] == 0
    with hapticdb.open("b.db") as env:
        for n in range(2 * render.MOST_ROWS):
            write_voxels(env.store, np.array([[1, 2, 3]]), f"new {n}")
    code, out, _ = run("diff", scene, "b.db")
    lines = out.splitlines()
    assert code == 1
    assert len(lines) == render.MOST_ROWS + 4
    cut = f"{2 * render.MOST_ROWS} differences, {render.MOST_ROWS} of them shown"
    assert lines[-1].startswith(cut)


def test_diff_other_grid(run: Run, scene: Path) -> None:
    hapticdb.create("b.db", Grid(0.01, (0, 0, 0), 6)).close()
    code, out, _ = run("diff", scene, "b.db")
    assert code == 1
    assert out.startswith("other grids, so that rows cannot be compared: 64^3 voxels of ")
    refused(run("copy", scene, "b.db"), "another grid")


@pytest.mark.usefixtures("scene")
@pytest.mark.parametrize("args", [["scene.db", "none.db"], ["none.db", "scene.db"]])
def test_diff_missing_environment(run: Run, args: list[str]) -> None:
    refused(run("diff", *args), "no environment at none.db")


# -- interrupted, and on a terminal ---------------------------------------------------------------


def test_copy_resumes_after_interrupt(
    run: Run, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add, left = FileTables.add, [1]

    def interrupted(writer: FileTables, record: Object, rows: Rows, surface: bytes) -> int:
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return add(writer, record, rows, surface)

    with monkeypatch.context() as patched:
        patched.setattr(FileTables, "add", interrupted)
        code, _, err = run("copy", scene, "b.db")
    assert code == 130
    assert "the same command goes on from there" in err
    assert "2 objects copied" in (out := run("copy", scene, "b.db")[1])
    assert out.endswith("; 1 were there already\n")
    assert run("diff", scene, "b.db")[0] == 0


@pytest.mark.usefixtures("run")
def test_copy_bar_on_terminal(scene: Path) -> None:
    assert "copying" in on_terminal("copy", scene, "b.db")
