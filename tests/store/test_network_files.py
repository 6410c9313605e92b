"""On a network file system no SQLite file is written; one without a log is read."""

import os
from pathlib import Path

import pytest

from command_line import Run, refused, succeeded
from hapticdb.errors import ReadOnlyError
from hapticdb.grid import Grid
from hapticdb.store.sqlite import database_file as sqlite_file
from hapticdb.store.sqlite.sqlite_store import SQLiteStore
from voxels import blob, write_voxels

GRID = Grid(0.01, (0.0, 0.0, 0.0), 6)


def mount(monkeypatch: pytest.MonkeyPatch, folder: Path, kind: str) -> None:
    """Have the folder's device listed as a file system of a type."""
    device = folder.stat().st_dev
    name = f"{os.major(device)}:{os.minor(device)}"
    lines = ["1 0 0:0 / / rw shared:1 - nfs4 host:/ rw", f"2 1 {name} / /a rw - {kind} host:/a rw"]
    listed = folder / "mountinfo"
    listed.write_text("\n".join(lines) + "\n")
    monkeypatch.setattr(sqlite_file, "MOUNTS", listed)


def environment(path: Path) -> Path:
    store = SQLiteStore.create(path, GRID)
    write_voxels(store, blob(1, (20, 20, 20)), "one")
    store.close()
    return path


@pytest.mark.parametrize("kind", ["nfs", "nfs4", "cifs", "smb3"])
def test_open_network_file_read_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    path = environment(tmp_path / "a.db")
    mount(monkeypatch, tmp_path, kind)
    with pytest.raises(ReadOnlyError, match=rf"a network file system \({kind}\).*hapticdb backup"):
        SQLiteStore.open(path)
    with pytest.raises(ReadOnlyError, match=r"on a local disk, or in PostgreSQL"):
        SQLiteStore.create(tmp_path / "b.db", GRID)
    store = SQLiteStore.open(path, read_only=True)
    assert [obj.name for obj in store.objects()] == ["one"]
    store.close()
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.db", "mountinfo"]


def test_open_network_file_with_log_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = SQLiteStore.open(environment(tmp_path / "a.db"))
    write_voxels(writer, blob(2, (24, 20, 20)), "two")
    mount(monkeypatch, tmp_path, "nfs4")
    with pytest.raises(ReadOnlyError, match=r"a.db-wal holds changes .* network file system"):
        SQLiteStore.open(tmp_path / "a.db", read_only=True)
    writer.close()


def test_open_local_file_systems_writable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing is listed, as on another operating system, too."""
    mount(monkeypatch, tmp_path, "ext4")
    environment(tmp_path / "a.db")
    monkeypatch.setattr(sqlite_file, "MOUNTS", tmp_path / "none")
    environment(tmp_path / "b.db")


def test_remove_network_file_message(
    run: Run, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mount(monkeypatch, scene.parent, "cifs")
    line = refused(run("remove", scene, 1), "(cifs)", "local disk", "it can be read here")
    assert f"hapticdb backup {scene} COPY" in line
    succeeded(run("objects", scene))
    assert len(refused(run("import", "new.db", "tool.stl"), "new.db", "PostgreSQL")) < 250
    assert not Path("new.db").exists()
