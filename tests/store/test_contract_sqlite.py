"""SQLite passes the contract suite; tests of what only SQLite does."""

import itertools
import os
import shutil
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import apsw
import numpy as np
import pytest

import hapticdb
from children import child, exit_code, finished
from contract.store import StoreContract
from files_in_use import GRID, make
from hapticdb.store.connect import backup_environment
from hapticdb.store.sqlite import opened_file
from hapticdb.store.sqlite.database_file import BEFORE_FORMAT_1, named_errors
from hapticdb.store.sqlite.sqlite_store import SQLiteStore
from hapticdb.store.store_errors import FORMAT
from voxels import blob, with_distances, write_voxels

ALL_KEYS = np.array([0]), np.array([1 << 9])


@pytest.fixture
def new_url(tmp_path: Path) -> Callable[[], str]:
    """Gives URLs of files that are not there yet."""
    numbers = itertools.count()
    return lambda: f"sqlite:///{tmp_path}/e{next(numbers)}.db"


class TestSQLiteStore(StoreContract):
    pass


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Path of a small environment that no store has open."""
    return make(tmp_path / "e.db")


def write_text(path: Path) -> None:
    path.write_text("x,y,z\n" * 100)


def write_newer_version(path: Path) -> None:
    with closing(sqlite3.connect(path)) as plain, plain:
        plain.execute(f"PRAGMA user_version = {FORMAT + 1}")


def write_former_mark(path: Path) -> None:
    with closing(sqlite3.connect(path)) as plain, plain:
        plain.execute(f"PRAGMA application_id = {BEFORE_FORMAT_1}")
        plain.execute("PRAGMA user_version = 7")


def add_former_table(path: Path) -> None:
    """Distances had a table of their own."""
    with closing(sqlite3.connect(path)) as plain, plain:
        plain.execute("CREATE TABLE band (z_val INTEGER)")


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


@pytest.mark.parametrize(
    ("damage", "error", "words"),
    [
        (write_text, hapticdb.errors.NotAnEnvironmentError, "no hapticdb environment"),
        (empty, hapticdb.errors.NotAnEnvironmentError, "is empty"),
        (write_former_mark, hapticdb.errors.NotAnEnvironmentError, r"was made before 0\.1; import"),
        (add_former_table, hapticdb.errors.NotAnEnvironmentError, r"was made before 0\.1; import"),
        (write_newer_version, hapticdb.errors.NewerVersionError, "install a newer"),
        (cut_off, hapticdb.errors.DamagedError, "is damaged"),
        (Path.unlink, hapticdb.errors.EnvironmentNotFoundError, "no environment at"),
    ],
)
@pytest.mark.parametrize("read_only", [False, True])
def test_open_not_an_environment_untouched(
    path: Path, damage: Callable[[Path], None], error: type[Exception], words: str, read_only: bool
) -> None:
    damage(path)
    before = path.read_bytes() if path.exists() else None
    with pytest.raises(error, match=words) as caught:
        hapticdb.open(path, read_only=read_only)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    assert (path.read_bytes() if path.exists() else None) == before


def test_open_unprivileged_reader_of_read_only_folder(path: Path, tmp_path: Path) -> None:
    """A WAL database needs its -shm file, which only root could create in this folder."""
    for folder in (tmp_path, *tmp_path.parents):
        if not os.access(folder, os.X_OK) or folder == Path(tmp_path.anchor):
            break
        folder.chmod(folder.stat().st_mode | 0o055)
    tmp_path.chmod(0o555)
    path.chmod(0o444)
    failures: list[str] = []
    read_end, write_end = os.pipe()
    pid = os.fork()
    if pid == 0:  # fork is safe: all modules are imported, and no thread runs
        try:
            if os.getuid() == 0:
                os.setgid(65534)
                os.setuid(65534)
            env = hapticdb.open(path, read_only=True)
            os.write(write_end, f"{env.size().rows} {len(env.objects())}".encode())
        except BaseException as error:  # noqa: BLE001 - reported to the parent
            os.write(write_end, repr(error).encode())
        finally:
            os._exit(0)
    os.close(write_end)
    assert exit_code(pid) == 0
    answer = os.read(read_end, 1000).decode()
    os.close(read_end)
    tmp_path.chmod(0o755)
    assert not failures
    assert answer == f"{hapticdb.open(path).size().rows} 1"


def test_open_immutable_reader_notices_writer(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hapticdb.store.sqlite.database_file.needs_immutable", lambda _: True)
    reader = SQLiteStore.open(path, read_only=True)
    monkeypatch.undo()
    assert len(reader.objects()) == 1
    writer = SQLiteStore.open(path)
    write_voxels(writer, blob(1, (30, 30, 30)), "blob")
    with pytest.raises(hapticdb.errors.BusyError, match="open it again"):
        reader.objects()


def test_write_busy_database(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hapticdb.store.sqlite.database_file.BUSY_TIMEOUT_MS", 50)
    first, second = SQLiteStore.open(path), SQLiteStore.open(path)
    with (
        first._connection.writing(),
        pytest.raises(hapticdb.errors.BusyError, match="another process"),
    ):
        write_voxels(second, blob(1, (30, 30, 30)), "blob")
    write_voxels(second, blob(1, (30, 30, 30)), "blob")
    assert len(first.objects()) == 2


def test_create_removes_unfinished_creation(tmp_path: Path) -> None:
    """A process that dies while it creates an environment leaves a file of a temporary name."""
    with child([sys.executable, "-c", ""]) as dead:
        pass
    lefts = [tmp_path / f".e.db.{dead.pid}.new{suffix}" for suffix in ("", "-wal", "-shm")]
    for left in lefts:
        left.write_bytes(b"half")
    hapticdb.create(tmp_path / "e.db", GRID).close()
    assert not any(left.exists() for left in lefts)
    assert len(hapticdb.open(tmp_path / "e.db").objects()) == 0


def test_write_disk_full_rolls_back(path: Path) -> None:
    store = SQLiteStore.open(path)
    driver = store._connection.driver
    n_pages = driver.execute("PRAGMA page_count").fetchall()[0][0]
    driver.execute(f"PRAGMA max_page_count = {n_pages}")

    def fill() -> None:
        for n in range(1000):
            write_voxels(store, blob(9, (30, 30, 30)), f"blob {n}")

    with pytest.raises(hapticdb.errors.DatabaseError, match="the disk is full"):
        fill()
    n_there = len(store.objects())
    driver.execute("PRAGMA max_page_count = 1000000")
    write_voxels(store, blob(9, (30, 30, 30)), "last")
    assert len(store.objects()) == n_there + 1


def test_create_file_size_limit_is_not_damage(tmp_path: Path) -> None:
    program = (
        "import resource, hapticdb\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
        "try: hapticdb.create('new.db', hapticdb.Grid(0.01, (0, 0, 0), 5))\n"
        "except hapticdb.errors.DatabaseError as error: print(type(error).__name__, error)\n"
    )
    told = finished([sys.executable, "-c", program], cwd=tmp_path).stdout
    assert told.startswith("DatabaseError")
    assert "limits of file sizes" in told
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("free", [0, 1 << 40])
def test_named_errors_disk_full_or_not(
    path: Path, free: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = shutil.disk_usage(path.parent)._replace(free=free)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: space)
    with pytest.raises(hapticdb.errors.DatabaseError) as raised, named_errors(str(path)):
        raise apsw.IOError("not an error")
    assert ("the disk is full" in str(raised.value)) == (free == 0)
    assert "not an error" not in str(raised.value)


def test_open_read_only_copy_with_log(
    path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    log = Path(f"{path}-wal")
    log.touch()
    monkeypatch.setattr(os, "access", lambda _, mode: mode != os.W_OK)
    with closing(SQLiteStore.open(path, read_only=True)) as store:
        assert len(store.objects()) == 1
    with pytest.raises(hapticdb.errors.ReadOnlyError, match="hapticdb backup"):
        SQLiteStore.open(path)
    monkeypatch.undo()
    backup_environment(path, tmp_path / "copy.db")
    monkeypatch.setattr(os, "access", lambda _, mode: mode != os.W_OK)
    other = shutil.copy(path, tmp_path / "other.db")
    Path(f"{other}-wal").write_bytes(b"\1" * 100)
    for read_only in (True, False):
        with pytest.raises(hapticdb.errors.ReadOnlyError, match="copy both files"):
            SQLiteStore.open(other, read_only=read_only)


def test_loading_full_pages_beside_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opened_file, "CHECK_SECONDS", 0.0)
    rng = np.random.default_rng(1)
    parts = [np.unique(rng.integers(0, 64, (200, 3)), axis=0) for _ in range(30)]
    fold = "PRAGMA wal_checkpoint(TRUNCATE)"
    with (
        closing(SQLiteStore.create(tmp_path / "q.db", GRID)) as store,
        closing(SQLiteStore.open(tmp_path / "q.db", read_only=True)) as reader,
    ):
        with store.loading():
            for n, voxels in enumerate(parts):
                write_voxels(store, voxels, f"part {n}", with_distances(voxels, GRID, "brick"))
            store._connection.driver.execute(fold)
            rows, before = reader.scan(*ALL_KEYS), store.path.stat().st_size
            assert reader.revision() == len(parts)
        store._connection.driver.execute(fold)
        assert store.path.stat().st_size < 0.95 * before
        for one in (store, reader):
            assert one.revision() == len(parts)
            again = one.scan(*ALL_KEYS)
            assert np.array_equal(again.keys, rows.keys)
            assert np.array_equal(again.ids, rows.ids)
            assert np.array_equal(again.occupancy, rows.occupancy)
        write_voxels(store, parts[0], "another")
        assert reader.revision() == len(parts) + 1


def test_environments_left_open_end_silently(tmp_path: Path) -> None:
    program = (
        "import hapticdb\n"
        "grid = hapticdb.Grid(0.01, (0, 0, 0), 5)\n"
        "kept = [hapticdb.create(f'{n}.db', grid) for n in range(3)]\n"
        "kept.append(kept)\n"
    )
    ended = finished([sys.executable, "-c", program], cwd=tmp_path)
    assert (ended.stdout, ended.stderr) == ("", "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.db", "1.db", "2.db"]
