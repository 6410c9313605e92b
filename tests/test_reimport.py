"""A file that is imported once more: what was removed meanwhile comes back, told, or stays out."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import json
from pathlib import Path

import pytest

import hapticdb
from command_line import Run, boxes, made, run, scene  # noqa: F401 - fixtures


def names(url: Path) -> list[str]:
    with hapticdb.open(url, read_only=True) as env:
        return [obj.name for obj in env.objects()]


@pytest.fixture
def file(made: Path) -> Path:
    return made / "boxes.glb"


def test_what_was_removed_comes_back_and_is_told(run: Run, scene: Path, file: Path) -> None:
    assert run("remove", scene, "box0", "box2")[0] == 0
    code, out, err = run("import", scene, file)
    assert (code, err) == (0, "")
    assert "2 objects imported" in out
    assert "2 of them had been removed and are back: --keep-removed" in out
    assert sorted(names(scene)) == ["box0", "box1", "box2"]
    code, out, _ = run("import", scene, file)
    assert "complete already (3 objects), nothing to do" in out
    assert "removed" not in out


def test_what_was_removed_stays_so_when_asked(run: Run, scene: Path, file: Path) -> None:
    assert run("remove", scene, "box0", "box2")[0] == 0
    keep = ("import", scene, file, "--keep-removed")
    code, out, err = run(*keep)
    assert (code, err) == (0, "")
    assert "complete already (1 object), nothing to do; 2 removed parts left out" in out
    found = json.loads(run(*keep, "--json")[1])
    assert (found["present"], found["restored"], found["kept_removed"]) == (1, 0, 2)
    assert names(scene) == ["box1"]
    with hapticdb.open(scene) as env:
        report = env.add(file, keep_removed=True)
        assert (report.added, report.kept_removed) == ((), 2)
        report = env.add(file)
        assert (len(report.added), report.restored, report.kept_removed) == (2, 2, 0)


def test_what_was_never_there_is_not_held_for_removed(run: Run, tmp_path: Path) -> None:
    """New parts of a file, an interrupted import, and parts of the same name in another file."""
    file = boxes(tmp_path / "boxes.glb", 2)
    assert run("import", "a.db", file, "--bits", 6, "--extent", 4)[0] == 0
    assert run("remove", "a.db", "box0")[0] == 0
    boxes(file, 4)
    code, out, _ = run("import", "a.db", file, "--keep-removed")
    assert code == 0
    assert "2 objects imported" in out
    assert "1 removed part left out" in out
    assert names(tmp_path / "a.db") == ["box1", "box2", "box3"]
    other = boxes(tmp_path / "other.glb", 1)
    found = json.loads(run("import", "a.db", other, "--keep-removed", "--json")[1])
    assert (found["objects"], found["kept_removed"]) == (1, 0)
