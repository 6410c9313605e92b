"""A page of a file that differs from what was written is an error, whatever it holds."""

import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import apsw
import numpy as np
import pytest

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.store.base import Layout
from hapticdb.store.believed import TABLES
from hapticdb.store.schema import FORMAT_VERSION
from hapticdb.store.sqlite import pages as sqlite_pages
from hapticdb.store.sqlite.pages import LAYER, PAGE_BYTES
from hapticdb.store.sqlite.store import SQLiteStore
from hapticdb.testing import floor_voxels, write_voxels

GRID = Grid(0.005, (0, 0, 0), 7)


def made(path: Path, layout: Layout = "brick") -> Path:
    """An environment of a few dozen pages that no store has open."""
    with closing(SQLiteStore.create(path, GRID, layout)) as store:
        for name in ("a", "b", "c"):
            width = 96 if layout == "brick" else 24
            write_voxels(store, floor_voxels(GRID, width=width), name)
    return path


@pytest.fixture(params=["brick", "voxel"])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return made(tmp_path / "e.db", request.param)


def page(number: int) -> slice:
    return slice((number - 1) * PAGE_BYTES, number * PAGE_BYTES)


def read_all(path: Path) -> None:
    """Read every row, as frames, listings and statistics do."""
    with hapticdb.open(path, read_only=True) as env:
        env.objects()
        env.store.scan(np.zeros(1, np.int64), np.full(1, 1 << 62))
        env.size()
        env.quantiles(10)


def flip_a_bit(content: bytearray, number: int) -> None:
    content[page(number).start + 777] ^= 4


def zero(content: bytearray, number: int) -> None:
    content[page(number)] = bytes(PAGE_BYTES)


def swap(content: bytearray, number: int) -> None:
    other = number + 1 if number < len(content) // PAGE_BYTES else 2
    content[page(number)], content[page(other)] = content[page(other)], content[page(number)]


def duplicate(content: bytearray, number: int) -> None:
    content[page(number)] = content[page(number - 1 if number > 2 else 3)]


@pytest.mark.parametrize("damage", [flip_a_bit, zero, swap, duplicate])
def test_damage_to_any_page_is_told(path: Path, damage: Callable[[bytearray, int], None]) -> None:
    """Damage is found on every page that is read."""
    whole = path.read_bytes()
    n_pages = len(whole) // PAGE_BYTES
    told = 0
    for number in range(2, n_pages + 1):
        content = bytearray(whole)
        damage(content, number)
        path.write_bytes(content)
        try:
            read_all(path)
        except hapticdb.DamagedError as error:
            told += "is not what was written" in str(error)
    # not found: pages of eight tables and indexes that are not read; page 1 stays whole here
    assert told >= n_pages - 9


def test_a_page_of_another_environment_is_told(path: Path, tmp_path: Path) -> None:
    """A page of another file is an error, even with the same number and the same rows."""
    with closing(SQLiteStore.open(path)) as store:
        layout = store.layout
    other = made(tmp_path / "other.db", layout).read_bytes()
    content = bytearray(path.read_bytes())
    assert len(other) == len(content)
    last = page(len(content) // PAGE_BYTES)
    content[last] = other[last]
    path.write_bytes(content)
    with pytest.raises(hapticdb.DamagedError, match="is not what was written"):
        read_all(path)


@pytest.mark.parametrize("at", [20, 60, 28, 100, PAGE_BYTES - 16, PAGE_BYTES - 3])
def test_damage_to_the_header_does_not_end_the_checking(path: Path, at: int) -> None:
    """Damaged: size of the tail, version, number of pages, application mark, or checksum."""
    content = bytearray(path.read_bytes())
    content[at : at + 4] = bytes(4)
    path.write_bytes(content)
    with pytest.raises((hapticdb.DamagedError, hapticdb.NewerVersionError)):
        read_all(path)


def test_damage_to_the_log_is_told(path: Path) -> None:
    """Found also while others have the log open, when SQLite itself checks no checksum."""
    env = hapticdb.open(path)
    write_voxels(env.store, floor_voxels(GRID), "later")
    log = Path(f"{path}-wal")
    content = bytearray(log.read_bytes())
    for start in range(32, len(content), sqlite_pages.FRAME_BYTES):
        content[start + 24 + 5000] ^= 1
    log.write_bytes(content)
    with pytest.raises(hapticdb.DamagedError, match="-wal is not as written"):
        read_all(path)
    with pytest.raises(hapticdb.DamagedError, match="-wal is not as written"):
        env.close()  # the last close copies the log into the file, but no damaged page


def test_a_transaction_larger_than_the_cache_reads_what_it_wrote(tmp_path: Path) -> None:
    """Its frames are written twice, and their checksums are right at the commit."""
    file = made(tmp_path / "e.db")
    rng = np.random.default_rng(0)
    with hapticdb.open(file) as env:
        env.store.limit_cache(64 * 1024)  # type: ignore[attr-defined]
        connection = apsw.Connection(str(file), vfs=LAYER)
        connection.execute("PRAGMA cache_size = 10")
        with closing(connection), connection:
            for key in rng.permutation(4096).tolist():
                connection.execute("INSERT INTO brick VALUES (?, 9, zeroblob(64))", (key,))
            connection.execute("UPDATE brick SET occupancy = randomblob(64) WHERE id = 9")
            assert connection.execute("SELECT count(*) FROM brick WHERE id = 9").get == 4096
        found = env.store.scan(np.zeros(1, np.int64), np.full(1, 1 << 62))
        assert int((found.ids == 9).sum()) == 4096
    read_all(file)


def test_the_checksum_of_a_frame_is_sqlites() -> None:
    rng = np.random.default_rng(3)
    words = rng.integers(0, 1 << 32, 6 + PAGE_BYTES // 4, dtype=np.uint32)
    s1, s2 = 5, 7
    told = [*words[:2].tolist(), *words[6:].tolist()]
    for even, odd in zip(told[::2], told[1::2], strict=True):
        s1 = (s1 + even + s2) & 0xFFFFFFFF
        s2 = (s2 + odd + s1) & 0xFFFFFFFF
    assert sqlite_pages.log_checksum(words, 5, 7) == (s1, s2)


def test_a_file_edited_by_another_program_is_told(path: Path) -> None:
    with closing(sqlite3.connect(path)) as plain, plain:
        plain.execute("UPDATE object SET voxels = voxels + 1")
    with pytest.raises(hapticdb.DamagedError, match="is not what was written"):
        read_all(path)


def without_checksums(path: Path) -> Path:
    """The same environment in the older format, which had no checksums."""
    old = path.with_name("old.db")
    with closing(apsw.Connection(str(path), vfs=LAYER)) as connection:
        script = [
            row[0]
            for row in connection.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL")
            if "sqlite_sequence" not in row[0]
        ]
        tables = {
            name: connection.execute(f"SELECT * FROM {name}").fetchall()
            for name in (*TABLES, "band")
        }
    with closing(apsw.Connection(str(old))) as plain:
        plain.execute(f"PRAGMA page_size = {PAGE_BYTES}")
        plain.execute("PRAGMA journal_mode = WAL").fetchall()
        plain.execute("PRAGMA application_id = 0x48415054")
        plain.execute(f"PRAGMA user_version = {FORMAT_VERSION}")
        for statement in script:
            plain.execute(statement)
        for name, rows in tables.items():
            for row in rows:
                plain.execute(f"INSERT INTO {name} VALUES ({','.join('?' * len(row))})", row)
    return old


def test_a_file_without_checksums_opens_and_a_copy_has_them(
    path: Path, tmp_path: Path, sphere: PointShell
) -> None:
    old = without_checksums(path)
    pose = np.eye(4)
    pose[:3, 3] = 0.1, 0.1, 0.01
    with hapticdb.open(path) as new, hapticdb.open(old) as env:
        assert env.objects()[0].name == new.objects()[0].name
        assert (env.touch(sphere, pose).force == new.touch(sphere, pose).force).all()
        write_voxels(env.store, floor_voxels(GRID), "later")
    hapticdb.copy_environment(old, tmp_path / "copy.db")
    assert sqlite_pages.is_checked((tmp_path / "copy.db").read_bytes()[:PAGE_BYTES])
    assert not sqlite_pages.is_checked(old.read_bytes()[:PAGE_BYTES])


def test_a_link_leads_to_the_file_and_its_log(path: Path, tmp_path: Path) -> None:
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "link.db").symlink_to(path)
    with hapticdb.open(folder / "link.db") as env:
        write_voxels(env.store, floor_voxels(GRID), "later")
        assert Path(f"{path}-wal").exists()
        assert [entry.name for entry in folder.iterdir()] == ["link.db"]


def test_closing_a_reader_is_quiet(path: Path, tmp_path: Path) -> None:
    """The last reader closes without an error, also when the file is gone."""
    env = hapticdb.open(path, read_only=True)
    env.objects()
    shutil.rmtree(tmp_path)
    env.close()


def test_sizes_and_marks_of_a_new_file(path: Path) -> None:
    header = path.read_bytes()[:100]
    assert struct.unpack(">H", header[16:18]) == (PAGE_BYTES,)
    assert header[20] == sqlite_pages.TAIL_BYTES
    assert isinstance(hapticdb.open(path), Environment)
