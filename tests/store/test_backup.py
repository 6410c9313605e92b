"""Backups of SQLite environments: made while others write, put back, never incomplete."""

import json
import os
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import NoReturn

import apsw
import pytest

import hapticdb
from children import child, finished
from command_line import Run, refused, succeeded
from files_in_use import killed, make, write
from hapticdb import backup_environment
from hapticdb.store.sqlite import raw as sqlite_bytes
from hapticdb.store.sqlite.sqlite_store import SQLiteStore


def names(path: Path) -> list[str]:
    with hapticdb.open(path) as env:
        assert env.store.revision() == len(env.objects())
        return [obj.name for obj in env.objects()]


def files(folder: Path) -> dict[str, bytes]:
    """Contents of a folder, without the empty log and the log's index that a reader leaves."""
    found = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    return {
        name: content
        for name, content in found.items()
        if not name.endswith("-shm") and (content or not name.endswith("-wal"))
    }


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return make(tmp_path / "q.db", 1)


@pytest.fixture
def copy(path: Path, tmp_path: Path) -> Path:
    """A backup of `path`; after the backup another object is written to `path`."""
    backup_environment(path, tmp_path / "copy.db")
    with closing(SQLiteStore.open(path)) as store:
        write(store, 2)
    return tmp_path / "copy.db"


def test_backup_equals_source_without_log(path: Path, tmp_path: Path) -> None:
    with closing(SQLiteStore.open(path)) as store:
        write(store, 2)  # goes into the log
        report = backup_environment(path, tmp_path / "copy.db")
        assert (report.revision, report.objects) == (3, 3)
        assert report.bytes == (tmp_path / "copy.db").stat().st_size
        assert hapticdb.diff_environments(path, tmp_path / "copy.db").is_equal
    assert sorted(files(tmp_path)) == ["copy.db", "q.db"]
    assert names(tmp_path / "copy.db") == ["floor", "blob 1", "blob 2"]


def test_backup_beside_writer_is_one_revision(path: Path, tmp_path: Path) -> None:
    script = (
        "import sys\n"
        "from hapticdb.store.sqlite.sqlite_store import SQLiteStore\n"
        "from voxels import blob, write_voxels\n"
        "store = SQLiteStore.open(sys.argv[1])\n"
        "for n in range(10**6):\n"
        "    write_voxels(store, blob(n, (30, 30, 30)), f'blob {n + 2}')\n"
        "    print(n, flush=True)\n"
    )
    paths = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with child([sys.executable, "-c", script, str(path)], env=paths) as writer:
        assert writer.stdout is not None
        for n in range(5):
            writer.stdout.readline()
            backup_environment(path, tmp_path / f"{n}.db")
        writer.kill()
    for n in range(5):
        found = names(tmp_path / f"{n}.db")
        assert found == ["floor", *(f"blob {k}" for k in range(1, len(found)))]
        assert len(found) > n + 2


def test_backup_replace_existing_file(copy: Path, path: Path) -> None:
    before = files(copy.parent)
    with pytest.raises(hapticdb.errors.EnvironmentExistsError, match="exists already"):
        backup_environment(path, copy)
    assert files(copy.parent) == before
    copy.chmod(0o640)
    backup_environment(path, copy, replace=True)
    assert names(copy) == ["floor", "blob 1", "blob 2"]
    assert copy.stat().st_mode & 0o777 == 0o640


def test_backup_damaged_page(path: Path, tmp_path: Path) -> None:
    with closing(SQLiteStore.open(path, read_only=True)) as store:
        ((end,),) = store._connection.fetch("SELECT max(pageno) FROM dbstat WHERE name = 'brick'")
    content = bytearray(path.read_bytes())
    content[8192 * (end - 1) : 8192 * end] = bytes(8192)
    path.write_bytes(content)
    with pytest.raises(hapticdb.errors.DamagedError, match="what was to be copied is damaged"):
        backup_environment(path, tmp_path / "copy.db")
    assert sorted(files(tmp_path)) == ["q.db"]


def test_backup_restore_replaces_file_and_log(path: Path, copy: Path) -> None:
    killed(path, 3, 4)
    assert Path(f"{path}-wal").stat().st_size
    kept = copy.read_bytes()
    report = backup_environment(copy, path, replace=True)
    assert sorted(files(path.parent)) == ["copy.db", "q.db"]
    assert (report.revision, report.objects) == (2, 2)
    assert names(path) == ["floor", "blob 1"]
    assert copy.read_bytes() == kept


@pytest.mark.parametrize("what", ["nothing", "a log", "damaged"])
def test_backup_restore_over_missing_or_damaged_file(path: Path, copy: Path, what: str) -> None:
    if what == "damaged":
        path.write_bytes(path.read_bytes()[:8192] + bytes(8192))
    else:
        if what == "a log":
            killed(path, 3)
        path.unlink()
    backup_environment(copy, path, replace=True)
    assert sorted(files(path.parent)) == ["copy.db", "q.db"]
    assert names(path) == ["floor", "blob 1"]


@pytest.mark.parametrize("read_only", [False, True])
def test_backup_replace_open_file_refused(path: Path, copy: Path, read_only: bool) -> None:
    script = (
        "import sys, hapticdb\n"
        "env = hapticdb.open(sys.argv[1], read_only=sys.argv[2] == 'True')\n"
        "print('open', flush=True)\n"
        "sys.stdin.read()\n"
    )
    before = path.read_bytes()
    with closing(SQLiteStore.open(path, read_only=read_only)) as store:  # in this process
        with pytest.raises(hapticdb.errors.BusyError, match="is open"):
            backup_environment(copy, path, replace=True)
        assert len(store.objects()) == 3
    command = [sys.executable, "-c", script, str(path), str(read_only)]
    with child(command, stdin=-1) as holder:
        assert holder.stdout is not None
        assert holder.stdin is not None
        holder.stdout.readline()
        with pytest.raises(hapticdb.errors.BusyError, match="is open"):
            backup_environment(copy, path, replace=True)
        holder.stdin.close()
        holder.stdin = None
    assert path.read_bytes() == before
    backup_environment(copy, path, replace=True)
    assert names(path) == ["floor", "blob 1"]


def write_text(path: Path) -> None:
    path.write_text("mine\n" * 3000)


def write_database(path: Path) -> None:
    path.unlink(missing_ok=True)
    with closing(apsw.Connection(str(path))) as other:
        other.execute("CREATE TABLE t (a)")


def make_folder(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.mkdir()


@pytest.mark.parametrize("make", [write_text, write_database, make_folder])
def test_backup_not_an_environment(
    copy: Path, tmp_path: Path, make: Callable[[Path], None]
) -> None:
    other = tmp_path / "other"
    make(other)
    before = files(tmp_path)
    with pytest.raises(hapticdb.errors.NotAnEnvironmentError):
        backup_environment(copy, other, replace=True)
    with pytest.raises(hapticdb.errors.NotAnEnvironmentError):
        backup_environment(other, tmp_path / "q.db", replace=True)
    assert files(tmp_path) == before


@pytest.mark.usefixtures("path")
def test_backup_disk_full_names_target(tmp_path: Path) -> None:
    program = (
        "import resource, hapticdb\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (40000, 40000))\n"
        "try: hapticdb.backup_environment('q.db', 'copy.db')\n"
        "except hapticdb.errors.DatabaseError as error: print(error)\n"
    )
    told = finished([sys.executable, "-c", program], cwd=tmp_path).stdout
    assert told.startswith("copy.db cannot be read or written: look at the disk")
    assert not list(tmp_path.glob("*copy*"))


@pytest.mark.parametrize("step", ["sync_folder", "replace"])
def test_backup_replace_killed_is_atomic(
    path: Path, copy: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """The log of the former file never lies beside the copy, to which SQLite would apply it."""
    killed(path, 3)
    former = path.read_bytes()

    def die(*_: object, **__: object) -> NoReturn:
        raise SystemExit

    owner = sqlite_bytes if step == "sync_folder" else Path
    monkeypatch.setattr(owner, step, die)
    with pytest.raises(SystemExit):
        backup_environment(copy, path, replace=True)
    monkeypatch.undo()
    assert path.read_bytes() == former
    assert not Path(f"{path}-wal").exists()
    backup_environment(copy, path, replace=True)
    assert names(path) == ["floor", "blob 1"]


def test_backup_verb_output(run: Run, path: Path) -> None:
    out = succeeded(run("backup", path, "copy.db"))
    assert out.startswith(f"copy.db: {path} at revision 2, 2 objects, 0.")
    out = succeeded(run("backup", "copy.db", path, "--replace", "--json"))
    size = path.stat().st_size
    assert json.loads(out) == {
        "source": "copy.db",
        "target": str(path),
        "revision": 2,
        "objects": 2,
        "bytes": size,
    }


def test_backup_bad_paths(run: Run, path: Path, tmp_path: Path) -> None:
    before = files(tmp_path)
    refused(run("backup", path, path), "itself")
    refused(run("backup", path, tmp_path / "no" / "copy.db"), "does not exist")
    refused(run("backup", tmp_path / "no.db", "copy.db"), "no environment at")
    server = "postgresql://me:secret@host/plant"
    assert "secret" not in refused(run("backup", server, "copy.db"), "PostgreSQL", "hapticdb copy")
    refused(run("backup", path, server), "not a file")
    assert files(tmp_path) == before
