"""A database is deleted, moved or replaced while it is open: nobody gets a wrong answer."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from children import finished
from files_in_use import make, write
from hapticdb.store.sqlite.sqlite_store import SQLiteStore

EVERYWHERE = [(0, 2**62)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Path of a small environment that no store has open; a copy of it is beside it."""
    make(tmp_path / "q.db")
    shutil.copy(tmp_path / "q.db", tmp_path / "copy")
    return tmp_path / "q.db"


def replaced(path: Path) -> None:
    path.with_name("copy").replace(path)


def deleted(path: Path) -> None:
    path.unlink()


def moved(path: Path) -> None:
    path.rename(path.with_name("elsewhere.db"))


WRITES: list[Callable[[SQLiteStore], object]] = [
    lambda store: write(store, 2),
    lambda store: store.remove(1),
    lambda store: store.save_costs("here", {}),
    lambda store: store.analyze(10),
]


@pytest.mark.parametrize(
    ("event", "change"),
    [*((replaced, one) for one in WRITES), *((e, WRITES[0]) for e in (deleted, moved))],
)
def test_write_replaced_or_missing_file_refused(
    path: Path, event: Callable[[Path], None], change: Callable[[SQLiteStore], object]
) -> None:
    words = "another file" if event is replaced else "cannot be reached"
    store = SQLiteStore.open(path)
    write(store, 1)
    event(path)
    before = path.read_bytes() if path.exists() else None
    for _ in range(2):  # also on the second try
        with pytest.raises(hapticdb.errors.ConnectionLostError, match=words) as told:
            change(store)
        assert "\n" not in str(told.value)
        assert str(path) in str(told.value)
    store.close()  # changes the new file as little as the write
    assert (path.read_bytes() if path.exists() else None) == before


@pytest.mark.parametrize("event", [replaced, deleted])
def test_write_file_replaced_during_transaction(path: Path, event: Callable[[Path], None]) -> None:
    store = SQLiteStore.open(path)
    write(store, 1)
    with (
        pytest.raises(hapticdb.errors.ConnectionLostError, match=r"written last|cannot be reached"),
        store._connection.writing(),
    ):
        event(path)
    store.close()


def test_touch_replaced_file_no_foreign_commits(
    path: Path, sphere: hapticdb.PointShell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A store that opens the new file shares the log with the reader, which fails at once."""
    monkeypatch.setattr("hapticdb.store.sqlite.opened_file.CHECK_SECONDS", 1e6)
    with hapticdb.open(path, read_only=True) as env:
        env.touch(sphere, np.eye(4))
        replaced(path)
        with closing(SQLiteStore.open(path)) as other:
            write(other, 1)
            with pytest.raises(hapticdb.errors.ConnectionLostError, match="another file"):
                env.touch(sphere, np.eye(4))


def test_open_again_releases_no_locks(path: Path) -> None:
    """POSIX: a process that closes any descriptor of a file loses all its locks on that file."""
    script = (
        "import sys, apsw\n"
        "plain = apsw.Connection(sys.argv[1])\n"
        "plain.execute('PRAGMA locking_mode = EXCLUSIVE').fetchall()\n"
        "try: plain.execute('BEGIN EXCLUSIVE'); print('free')\n"
        "except apsw.BusyError: print('held')\n"
    )
    with closing(SQLiteStore.open(path)) as store:
        SQLiteStore.open(path).close()
        SQLiteStore.open(path, read_only=True).close()
        store.drop_caches()
        asked = finished([sys.executable, "-c", script, str(path)], stderr=subprocess.STDOUT)
        assert asked.stdout == "held\n"
