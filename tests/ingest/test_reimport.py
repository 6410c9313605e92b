"""A file that is imported once more: what was removed or has changed meanwhile."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import hapticdb
from command_line import Run, boxes, refused, rows_of, succeeded
from hapticdb.store.sqlite.tables.file_tables import FileTables


def names(url: Path) -> list[str]:
    with hapticdb.open(url, read_only=True) as env:
        return [obj.name for obj in env.objects()]


@pytest.fixture
def file(made: Path) -> Path:
    return made / "boxes.glb"


def test_import_restores_removed_parts(run: Run, scene: Path, file: Path) -> None:
    assert run("remove", scene, "box0", "box2")[0] == 0
    out = succeeded(run("import", scene, file))
    assert "2 objects imported" in out
    assert "2 of them had been removed and are back: --keep-removed" in out
    assert sorted(names(scene)) == ["box0", "box1", "box2"]
    out = succeeded(run("import", scene, file))
    assert "complete already (3 objects), nothing to do" in out
    assert "removed" not in out


def test_import_keep_removed(run: Run, scene: Path, file: Path) -> None:
    assert run("remove", scene, "box0", "box2")[0] == 0
    keep = ("import", scene, file, "--keep-removed")
    out = succeeded(run(*keep))
    assert "complete already (1 object), nothing to do; 2 removed parts left out" in out
    found = json.loads(run(*keep, "--json")[1])
    assert (found["present"], found["restored"], found["still_removed"]) == (1, 0, 2)
    assert names(scene) == ["box1"]
    with hapticdb.open(scene) as env:
        report = env.add(file, keep_removed=True)
        assert (report.added, report.still_removed) == ((), 2)
        report = env.add(file)
        assert (len(report.added), report.restored, report.still_removed) == (2, 2, 0)


def test_import_new_parts_are_not_restored(run: Run, tmp_path: Path) -> None:
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
    assert (found["objects"], found["still_removed"]) == (1, 0)


def changed_file(folder: Path) -> Path:
    """A changed file: box0 as before, box1 larger, no box2, and a new box3."""
    file = boxes(folder / "boxes.glb", 4)
    scene = trimesh.load_scene(file)
    scene.geometry["box1"].apply_scale(1.3)
    scene.delete_geometry(["box2"])
    file.write_bytes(scene.export(file_type="glb"))
    return file


def test_import_replace_changed_file(run: Run, tmp_path: Path) -> None:
    file = boxes(tmp_path / "boxes.glb")
    assert run("import", "a.db", file, "--bits", 6, "--extent", 3)[0] == 0
    before = rows_of(tmp_path / "a.db")
    changed_file(tmp_path)
    refused(run("import", "a.db", file), "has changed since it was imported", "--replace")
    assert rows_of(tmp_path / "a.db") == before
    out = succeeded(run("import", "a.db", file, "--replace"))
    assert "1 object imported" in out
    assert "; 1 were there already; 1 replaced; 1 removed, which the file has no more" in out
    with hapticdb.open("a.db") as env:
        assert [(obj.id, obj.name) for obj in env.objects()] == [
            (1, "box0"), (2, "box1"), (4, "box3"),
        ]  # fmt: skip
        assert np.allclose(np.ptp(env.object(2).bounds, axis=0), 0.13)
        assert all(len(env.voxels(obj.id)) == obj.voxels for obj in env.objects())
        grid = env.grid
    # equal to an environment that never held anything else
    options = hapticdb.GridOptions(bits=6, voxel_size=grid.voxel_size, origin=grid.origin)
    hapticdb.import_files("b.db", [file], hapticdb.ImportOptions(grid=options))
    assert run("diff", "a.db", "b.db")[0] == 0
    assert "nothing to do" in run("import", "a.db", file, "--replace")[1]


def test_import_replace_moved_object(run: Run, scene: Path, file: Path) -> None:
    before = rows_of(scene)
    other = boxes(scene.parent / "other.glb", 1, side=0.05)
    assert run("import", scene, other)[0] == 0
    assert run("move", scene, "2", "--translate", "0,0,0.02")[0] == 0
    found = json.loads(run("import", scene, file, "--replace", "--json")[1])
    assert (found["replaced"], found["dropped"], found["objects"]) == (1, 0, 0)
    assert run("remove", scene, "4")[0] == 0
    assert rows_of(scene) == before


def test_import_replace_resumes_after_interrupt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each part is the old or the new one; the same call again ends like an undisturbed one."""
    file = boxes(tmp_path / "boxes.glb")
    url = tmp_path / "a.db"
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=6, extent=3))
    hapticdb.import_files(url, [file], options)
    boxes(file, side=0.12)
    replace = FileTables.replace
    calls: list[int] = []

    def twice(writer: FileTables, *words: Any) -> None:  # noqa: ANN401 - handed on
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        replace(writer, *words)

    again = hapticdb.ImportOptions(replace=True)
    with monkeypatch.context() as patched:
        patched.setattr(FileTables, "replace", twice)
        with pytest.raises(KeyboardInterrupt):
            hapticdb.import_files(url, [file], again)
    assert names(url) == ["box0", "box1", "box2"]
    told: list[int] = []
    (report,) = hapticdb.import_files(url, [file], again, lambda now: told.append(now.parts_done))
    assert (report.error, report.replaced, report.present) == (None, 2, 1)
    assert sorted({1, *told}) == [1, 2, 3]
    with hapticdb.open(url, read_only=True) as env:
        for obj in env.objects():
            assert np.allclose(np.ptp(obj.bounds, axis=0), 0.12)


def test_import_replace_outside_grid_changes_nothing(run: Run, scene: Path, file: Path) -> None:
    mine = boxes(scene.parent / "mine.glb")
    assert run("import", scene, mine)[0] == 0
    before = rows_of(scene)
    boxes(mine, 30)
    refused(run("import", scene, mine, "--replace"), "outside the grid")
    assert rows_of(scene) == before
    assert file.exists()
