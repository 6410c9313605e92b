"""Frames over bricks in memory: the bits of frames that read, and the commits that empty it."""

import itertools
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from banded import write_points
from children import TIMEOUT, finished, until
from hapticdb import Environment, Touch
from hapticdb.errors import DamagedError, UsageError
from hapticdb.grid import CurveName
from hapticdb.kernels.records import rows as records
from hapticdb.query.brick_cache import BrickCache
from hapticdb.query.law import LawName
from hapticdb.store.base import Band, Keys, Rows
from hapticdb.store.sqlite.sqlite_store import SQLiteStore
from kernels.test_distance_law import random_pose, random_shell
from postgres_servers import Binaries
from query.test_distance_law import CURVES, make
from servers import ENGINES, named, url_on
from voxels import blob, write_voxels

LAWS: tuple[LawName, ...] = ("plane", "distance")
SHELL = random_shell(1, 200)
POSES = [random_pose(seed) for seed in range(12)]


@pytest.fixture(params=ENGINES, ids=named)
def env(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Environment]:
    """Overlapping objects with distances."""
    found: Binaries | None = request.param
    with url_on(found, tmp_path) as url, make(str(url)) as made:
        yield made


def assert_same(one: Touch, other: Touch) -> None:
    for array in ("force", "torque", "hits", "depths", "contacts", "contact_depths"):
        assert getattr(one, array).tobytes() == getattr(other, array).tobytes()
    assert one.ids == other.ids
    assert [obj.id for obj in one.objects] == one.ids
    assert one.pairs.tolist() == other.pairs.tolist()
    assert one.contact_pairs.tolist() == other.contact_pairs.tolist()


def check(env: Environment, law: LawName, exclude: list[int] | tuple[()] = ()) -> int:
    """Touch twice at each pose beside a frame that reads; number of contacts."""
    n_contacts = 0
    for pose in POSES:
        wanted = env.touch(SHELL, pose, "array", law=law, exclude=exclude)
        for _ in range(2):
            touch = env.touch(SHELL, pose, law=law, exclude=exclude)
            assert_same(touch, wanted)
        assert touch.query[:4] == ("array", 0, 0, 0)
        n_contacts += len(wanted.contacts)
    return n_contacts


def memory_of(env: Environment) -> BrickCache:
    memory = env._query._memory
    assert memory is not None
    return memory


def test_brick_cache_same_bits_as_reading(env: Environment) -> None:
    filters: list[list[int]] = [[], [1], [2, 3], [1, 2, 3], []]
    for law, exclude in itertools.product(LAWS, filters):
        n_contacts = check(env, law, exclude)
        assert (n_contacts > 0) is (exclude != [1, 2, 3])
    for law in LAWS:
        many = env.touch(SHELL, poses=POSES, law=law, objects=True)
        assert [many.ids_at(n) for n in range(len(POSES))] == [
            env.touch(SHELL, pose, "array", law=law).ids for pose in POSES
        ]


@pytest.mark.parametrize("curve", CURVES)
def test_brick_cache_every_curve(tmp_path: Path, curve: CurveName) -> None:
    with make(str(tmp_path / "e.db"), curve) as env:
        assert all(check(env, law) > 0 for law in LAWS)


def test_brick_cache_bricks_without_distances(tmp_path: Path) -> None:
    with (
        make(str(tmp_path / "e.db")) as made,
        hapticdb.create(tmp_path / "plain.db", made.grid, distances=False) as env,
    ):
        for seed, center in ((1, (20, 20, 20)), (2, (26, 22, 20))):
            write_voxels(env.store, blob(seed, center), f"blob {seed}")
        assert check(env, "plane") > 0
        with pytest.raises(UsageError, match="have no distances"):
            env.touch(SHELL, POSES[0], law="distance")
        assert check(env, "plane") > 0


def test_brick_cache_emptied_by_commit(env: Environment) -> None:
    def by_itself() -> None:
        env.remove(3)

    def by_its_store() -> None:
        env.store.remove(2)

    def by_another_connection() -> None:
        points = np.random.default_rng(1).uniform(20.0, 40.0, (40, 3))
        with hapticdb.open(env.address) as other:
            write_points(other.store, points)

    def by_another_process() -> None:
        script = "import sys, hapticdb; hapticdb.open(sys.argv[1]).remove(1)"
        finished([sys.executable, "-c", script, env.address])

    for write in (by_itself, by_its_store, by_another_connection, by_another_process):
        env.touch(SHELL, POSES[1])
        assert env.touch(SHELL, POSES[1]).query.statements == 0
        write()
        if write in {by_itself, by_its_store} or isinstance(env.store, SQLiteStore):
            assert env.touch(SHELL, POSES[1]).query.statements > 0
        else:  # its notification takes a moment
            until(lambda: env.touch(SHELL, POSES[1]).query.statements > 0)
        assert check(env, "distance") > 0


def test_brick_cache_unaffected_by_pairs(env: Environment) -> None:
    check(env, "plane")
    n_kept = memory_of(env).n_kept
    with hapticdb.open(env.address) as other:
        other.store.put_pairs([])
    check(env, "plane")
    assert memory_of(env).n_kept == n_kept > 0


def test_brick_cache_no_mixed_revisions(env: Environment, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another commits between what is in memory and what a frame reads."""
    lookup, n_lookups = env.store.lookup, 0

    def late(keys: Keys, *, distances: bool = False) -> Rows:
        nonlocal n_lookups
        n_lookups += 1
        if n_lookups == 1:
            other.remove(2)
        return lookup(keys, distances=distances)

    with hapticdb.open(env.address) as other:
        shifted = POSES[1].copy()
        shifted[:3, 3] += 10 * env.grid.voxel_size
        env.touch(SHELL, shifted)
        monkeypatch.setattr(env.store, "lookup", late)
        touch = env.touch(SHELL, POSES[1])
    assert n_lookups > 1
    assert 2 not in touch.ids
    monkeypatch.undo()
    assert_same(touch, env.touch(SHELL, POSES[1], "array"))


def test_brick_cache_snapshot_revision(env: Environment) -> None:
    env.touch(SHELL, POSES[1])
    with hapticdb.open(env.address) as other:
        with env.store.snapshot():
            before = env.touch(SHELL, POSES[1])
            other.remove(2)
            assert_same(env.touch(SHELL, POSES[1]), before)
        with env.store.snapshot():  # a server is asked, whatever it has notified
            after = env.touch(SHELL, POSES[1])
    assert 2 in before.ids
    assert 2 not in after.ids


def test_brick_cache_frames_beyond_capacity(
    env: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    check(env, "distance")
    memory = memory_of(env)
    most = 0
    enter = BrickCache.enter

    def noted(self: BrickCache, keys: Keys, rows: Rows) -> bool:
        nonlocal most
        did = enter(self, keys, rows)
        most = max(most, self._used)
        return did

    monkeypatch.setattr(BrickCache, "enter", noted)
    needed = memory._used
    held = [env.touch(SHELL, pose, law="distance") for pose in POSES]
    wanted = [env.touch(SHELL, pose, "array", law="distance") for pose in POSES]
    for most_rows in (needed // 2, needed // 4, 8, 0):
        memory.clear()
        memory.most_rows = most_rows
        for pose, other in zip(POSES, wanted, strict=True):
            assert_same(env.touch(SHELL, pose, law="distance"), other)
            assert memory._used <= max(most_rows, 1)
        assert most <= needed
        many = env.touch(SHELL, poses=POSES, law="distance", objects=True)
        assert [many.ids_at(n) for n in range(len(POSES))] == [one.ids for one in wanted]
    for one, other in zip(held, wanted, strict=True):  # of bricks that were dropped since
        assert_same(one, other)


def test_brick_cache_directory_grows(env: Environment) -> None:
    memory = BrickCache(env.url)
    keys = np.arange(0, 5000 * 7, 7)
    for some in np.split(keys, 10):
        assert memory.absent(keys).tolist() == keys[keys >= some[0]].tolist()
        assert memory.enter(some, Rows(keys[:0], keys[:0], np.frombuffer(b"", np.uint8)))
    assert not len(memory.absent(keys))
    assert len(memory.directory) >= 2 * len(keys)


def test_brick_cache_memory_budget(tmp_path: Path) -> None:
    for layout in (records.OCCUPIED, records.MEASURED):
        n_rows = layout["id"].shape[0]
        directory = records.ENTRIES_A_ROW * n_rows * records.BRICK.itemsize
        assert layout.itemsize + directory <= records.DECODED_BYTES == 64 << 20
    with make(str(tmp_path / "e.db")) as env:
        assert isinstance(env.store, SQLiteStore)
        ((kib,),) = env.store._connection.fetch("PRAGMA cache_size")
    assert -1024 * kib + records.DECODED_BYTES == 256 << 20


def test_brick_cache_damaged_distances(env: Environment, monkeypatch: pytest.MonkeyPatch) -> None:
    lookup = env.store.lookup

    def cut(keys: Keys, *, distances: bool = False) -> Rows:
        rows = lookup(keys, distances=distances)
        assert rows.distances is not None
        data, ends = rows.distances
        worse = np.frombuffer(bytes(255 - data), np.uint8)
        return rows.having(Band(worse, ends))

    env.touch(SHELL, POSES[0], law="plane")
    monkeypatch.setattr(env.store, "lookup", cut)
    with pytest.raises(DamagedError, match="distances is damaged"):
        env.touch(SHELL, POSES[1], law="distance")
    monkeypatch.undo()
    assert check(env, "distance") > 0


def test_brick_cache_other_thread_refused(env: Environment) -> None:
    env.touch(SHELL, POSES[0])
    with (
        ThreadPoolExecutor(1) as thread,
        pytest.raises(UsageError, match="belongs to the thread that opened it"),
    ):
        thread.submit(env.touch, SHELL, POSES[0]).result(TIMEOUT)


def test_brick_cache_non_rigid_pose(env: Environment) -> None:
    check(env, "plane")
    with pytest.raises(UsageError, match="no rigid transform"):
        env.touch(SHELL, np.diag([2.0, 1, 1, 1]))
