"""A log belongs to one file: with another file it is refused, with its own it is accepted."""

import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import apsw
import numpy as np
import pytest

import hapticdb
from files_in_use import killed, make, names, write
from hapticdb.store.sqlite import log as sqlite_log
from hapticdb.store.sqlite.store import SQLiteStore


def folder_bytes(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Path of a small environment that no store has open."""
    return make(tmp_path / "q.db")


@pytest.fixture
def stale(path: Path, tmp_path: Path) -> Path:
    """An environment replaced by an old copy, beside the log of a writer that was killed."""
    shutil.copy(path, tmp_path / "backup")
    with closing(SQLiteStore.open(path)) as store:
        write(store, 1, 2)
    killed(path, 3, 4)
    shutil.copy(path, tmp_path / "former")
    shutil.copy(tmp_path / "backup", path)
    return path


# --- a file that replaces another -----------------------------------------------------------------


@pytest.mark.parametrize("read_only", [False, True])
def test_an_old_copy_under_a_newer_log_is_refused_and_left_alone(
    stale: Path, read_only: bool
) -> None:
    before = folder_bytes(stale.parent)
    with pytest.raises(
        hapticdb.errors.DamagedError, match=r"q\.db-wal and q\.db-shm.*restore"
    ) as told:
        hapticdb.open(stale, read_only=read_only)
    assert "\n" not in str(told.value)
    assert folder_bytes(stale.parent) == before


def test_a_file_copied_over_one_that_is_being_written_is_noticed_by_the_next_write(
    path: Path, tmp_path: Path
) -> None:
    shutil.copy(path, tmp_path / "backup")
    with closing(SQLiteStore.open(path)) as store:
        write(store, 1)
    store = SQLiteStore.open(path)
    write(store, 2)
    shutil.copy(tmp_path / "backup", path)  # overwrites the file in the same inode
    with pytest.raises(hapticdb.errors.DamagedError, match="-wal"):
        write(store, 3)
    store.close()
    assert path.read_bytes() == (tmp_path / "backup").read_bytes()
    with pytest.raises(hapticdb.errors.DamagedError, match="-wal"):
        hapticdb.open(path)


# --- crashes at every moment ----------------------------------------------------------------------


class Tape(apsw.VFS):
    """A VFS on the system's files that records all writes to them, in order."""

    def __init__(self) -> None:
        self.steps: list[tuple[str, int, bytes | None]] = []
        super().__init__("tape", "", makedefault=True)

    def xOpen(self, name: Any, flags: Any) -> "TapedFile":  # noqa: ANN401, N802 - apsw's
        return TapedFile(self, name, flags)


class TapedFile(apsw.VFSFile):
    """One file. A recorded content of None is a sync, an offset of -1 a truncation."""

    def __init__(self, tape: Tape, name: Any, flags: Any) -> None:  # noqa: ANN401 - apsw's
        super().__init__("unix", name, flags)
        self._tape, self._name = tape, name if isinstance(name, str) else name.filename()

    def xWrite(self, data: bytes, offset: int) -> None:  # noqa: N802 - apsw's
        super().xWrite(data, offset)
        self._tape.steps.append((self._name, offset, bytes(data)))

    def xSync(self, flags: int) -> None:  # noqa: N802 - apsw's
        super().xSync(flags)
        self._tape.steps.append((self._name, 0, None))

    def xTruncate(self, size: int) -> None:  # noqa: N802 - apsw's
        super().xTruncate(size)
        self._tape.steps.append((self._name, -1, size.to_bytes(8)))


@pytest.fixture(scope="module")
def taped(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], Tape]:
    """A database before some changes, and all writes to the database and its log.

    The changes use several connections, several generations of the log, and checkpoints within one.
    """
    path = tmp_path_factory.mktemp("taped") / "q.db"
    make(path)
    start = {"q.db": path.read_bytes(), "q.db-wal": b""}
    tape = Tape()
    try:
        store, other = SQLiteStore.open(path), SQLiteStore.open(path)
        reader = SQLiteStore.open(path, read_only=True)
        for n in range(32):
            writing = (store, other)[n % 3 == 0]
            write(writing, n)
            if n % 4 == 3:
                writing.remove(writing.objects()[1].id, lambda _: [(0, 2**62)])
            if n % 8 == 5:
                with reader.snapshot():  # a snapshot keeps the log from starting again
                    reader.objects()
                    writing._connection.driver.wal_checkpoint()
                    write(writing, 100 + n)
                    writing._connection.driver.wal_checkpoint()
                write(writing, 200 + n)
            if n % 8 == 7:
                writing._connection.driver.wal_checkpoint()
        for each in (reader, store, other):
            each.close()
    finally:
        tape.unregister()
    return start, tape


def apply(files: dict[str, bytearray], step: tuple[str, int, bytes | None]) -> None:
    name, offset, content = step
    file = files.get(Path(name).name)
    if file is None or content is None:
        return
    if offset < 0:
        del file[int.from_bytes(content) :]
        return
    file.extend(bytes(max(offset + len(content) - len(file), 0)))
    file[offset : offset + len(content)] = content


def lay_out(folder: Path, files: dict[str, bytearray]) -> Path:
    for name, content in files.items():
        (folder / name).write_bytes(content)
    (folder / "q.db-shm").unlink(missing_ok=True)
    return folder / "q.db"


def test_a_log_is_never_refused_after_a_kill_between_any_two_writes(
    taped: tuple[dict[str, bytes], Tape], tmp_path: Path
) -> None:
    start, tape = taped
    files = {name: bytearray(content) for name, content in start.items()}
    n_objects: list[int] = []
    generations = set()
    for n, step in enumerate(tape.steps):
        apply(files, step)
        path = lay_out(tmp_path, files)
        sqlite_log.check_log(path)
        generations.add(bytes(files["q.db-wal"][16:24]))
        if n % 25 == 0:
            n_objects.append(len(names(path, read_only=False)))
    assert len(tape.steps) > 500
    assert len(generations) >= 3
    assert len(set(n_objects)) > 10


def test_a_log_is_never_refused_after_a_loss_of_power(
    taped: tuple[dict[str, bytes], Tape], tmp_path: Path
) -> None:
    """After a loss of power any subset of the 512-byte sectors since the last sync is on disk."""
    start, tape = taped
    rng = np.random.default_rng(0)
    files = {name: bytearray(content) for name, content in start.items()}
    pending: list[tuple[str, int, bytes | None]] = []
    for n, step in enumerate(tape.steps):
        name, offset, content = step
        if content is None or offset < 0:
            for late in [other for other in pending if other[0] == name]:
                apply(files, late)
            pending = [other for other in pending if other[0] != name]
            apply(files, step)
            continue
        pending += [
            (name, offset + at, content[at : at + 512]) for at in range(0, len(content), 512)
        ]
        if n % 3 == 0:
            torn = {key: bytearray(value) for key, value in files.items()}
            share = rng.uniform(0, 1)
            for late in pending:
                if rng.uniform() < share:
                    apply(torn, late)
            path = lay_out(tmp_path, torn)
            sqlite_log.check_log(path)
            if n % 60 == 0:
                names(path, read_only=False)


def test_every_older_copy_is_refused(taped: tuple[dict[str, bytes], Tape], tmp_path: Path) -> None:
    """With the last log, every file state before the log's own is refused."""
    start, tape = taped
    files = {name: bytearray(content) for name, content in start.items()}
    last = max(
        n
        for n, (name, offset, content) in enumerate(tape.steps)
        if name.endswith("-wal") and offset == 0 and content
    )
    olds, base = [], sqlite_log.NO_MARK
    for n, step in enumerate(tape.steps):
        if n == last:
            base = sqlite_log.file_mark(lay_out(tmp_path, files)) or base
        apply(files, step)
        if n % 40 == 0 and n < last:
            olds.append(bytes(files["q.db"]))
    refused = 0
    for old in olds:
        path = lay_out(tmp_path, files | {"q.db": bytearray(old)})
        if sqlite_log.file_mark(path) != base:
            with pytest.raises(hapticdb.errors.DamagedError):
                sqlite_log.check_log(path)
            refused += 1
    assert refused > 5
