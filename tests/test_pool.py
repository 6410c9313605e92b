"""A pool lends opened environments to threads, one at a time."""

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import psycopg
import pytest

import hapticdb
from children import PATIENCE
from hapticdb import Environment, Grid, PointShell, Pool
from hapticdb.store.postgres.address import parse
from hapticdb.testing import floor_voxels, write_voxels
from servers import Place

GRID = Grid(0.005, (-0.16, -0.16, -0.16), 6)


@pytest.fixture(params=["sqlite", "postgres"])
def url(request: pytest.FixtureRequest, tmp_path: Path, place: Place) -> str:
    where = str(tmp_path / "e.db") if request.param == "sqlite" else place()
    with hapticdb.create(where, GRID) as env:
        write_voxels(env.store, floor_voxels(GRID))
    return where


@pytest.fixture
def pool(url: str) -> Iterator[Pool]:
    with Pool(url, size=2, timeout=20) as made:
        yield made


def test_many_threads_share_few_environments(pool: Pool, sphere: PointShell) -> None:
    """Every frame of every thread is right, and at most `size` environments are lent at once."""
    with pool.environment() as env:
        expected = env.touch(sphere, np.eye(4)).force.tobytes()
    out: set[int] = set()
    most: list[int] = []
    lent: set[int] = set()

    def frames(_: int) -> None:
        for _ in range(10):
            with pool.environment() as env:
                out.add(id(env))
                most.append(len(out))
                lent.add(id(env))
                assert env.touch(sphere, np.eye(4)).force.tobytes() == expected
                out.discard(id(env))

    with ThreadPoolExecutor(8) as threads:
        list(threads.map(frames, range(8), timeout=PATIENCE))
    assert len(lent) <= 2
    assert max(most) <= 2


def test_the_one_given_back_last_is_lent_first(pool: Pool) -> None:
    """A single borrower thus opens one environment only, and its statistics stay loaded."""
    with pool.environment() as first:
        pass
    for _ in range(3):
        with pool.environment() as again:
            assert again is first
    with pool.environment() as one, pool.environment() as two:
        assert one is first is not two
    with pool.environment() as again:
        assert again is first


def test_who_waits_too_long_is_told(pool: Pool) -> None:
    with (
        pool.environment(),
        pool.environment(),
        pytest.raises(hapticdb.errors.BusyError, match="all 2 environments") as told,
        pool.environment(timeout=0.05),
    ):
        pass
    assert "\n" not in str(told.value)
    with pool.environment() as env:
        assert len(env.objects()) == 1


@pytest.mark.parametrize("timeout", [-1.0, np.nan])
def test_a_time_to_wait_that_is_none_is_refused(pool: Pool, timeout: float) -> None:
    with (
        pytest.raises(hapticdb.errors.UsageError, match="give seconds, 0 or more"),
        pool.environment(timeout=timeout),
    ):
        pass


def test_what_was_given_back_is_no_longer_ones_own(pool: Pool, sphere: PointShell) -> None:
    with pool.environment() as env:
        pass
    with pytest.raises(hapticdb.errors.UsageError, match="belongs to the thread"):
        env.touch(sphere, np.eye(4))
    with pool.environment() as again, ThreadPoolExecutor(1) as thread:
        assert again is env
        with pytest.raises(hapticdb.errors.UsageError, match="belongs to the thread"):
            thread.submit(env.objects).result(PATIENCE)


def test_a_member_that_was_closed_is_replaced(pool: Pool) -> None:
    with pool.environment() as first:
        first.close()
    with pool.environment() as one, pool.environment() as two:
        assert len(one.objects()) == len(two.objects()) == 1


def test_a_member_that_failed_is_replaced(pool: Pool) -> None:
    def fail(env: Environment) -> None:
        raise hapticdb.errors.DamagedError(f"{env.url} is damaged")

    with pytest.raises(hapticdb.errors.DamagedError), pool.environment() as first:
        fail(first)
    with pool.environment() as one, pool.environment() as two:
        assert first is not one
        assert first is not two
    with pytest.raises(KeyError), pool.environment() as kept:
        raise KeyError
    with pool.environment() as again:
        assert again is kept


def test_members_read_unless_asked_to_write(url: str, pool: Pool) -> None:
    with pytest.raises(hapticdb.errors.ReadOnlyError), pool.environment() as env:
        env.remove(1)
    with Pool(url, read_only=False) as editors, editors.environment() as env:
        env.remove(1)
    with pool.environment() as env:
        assert env.objects() == []


def test_a_closed_pool_lends_nothing_and_leaves_nothing_open(pool: Pool) -> None:
    with pool.environment() as env:
        pool.close()
        assert len(env.objects()) == 1  # a lent environment stays usable until returned
    with pytest.raises(hapticdb.errors.DatabaseError, match="has been closed"):
        env.objects()
    with pytest.raises(hapticdb.errors.DatabaseError, match="make a new one"), pool.environment():
        pass
    pool.close()


def test_closing_wakes_those_who_wait(url: str) -> None:
    with Pool(url, size=1) as pool, ThreadPoolExecutor(1) as thread:

        def borrow() -> None:
            with pool.environment(timeout=PATIENCE):
                pass

        with pool.environment():
            waiting = thread.submit(borrow)
            time.sleep(0.05)
            pool.close()
            with pytest.raises(hapticdb.errors.DatabaseError, match="has been closed"):
                waiting.result(PATIENCE)


def test_a_member_that_cannot_be_opened_takes_no_place(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: Pool) -> Environment:
        raise hapticdb.errors.AccessError("not now")

    with Pool(url, size=2) as pool, pool.environment():
        for _ in range(3):
            with monkeypatch.context() as patch:
                patch.setattr(Pool, "_opened", refuse)
                with pytest.raises(hapticdb.errors.AccessError), pool.environment():
                    pass
        with pool.environment(timeout=1) as env:
            assert env.objects()


def test_members_outlive_the_loss_of_their_connections(
    place: Place, admin: psycopg.Connection, sphere: PointShell
) -> None:
    where = place()
    with hapticdb.create(where, GRID) as env:
        write_voxels(env.store, floor_voxels(GRID))
    with Pool(where, size=2) as pool:
        with pool.environment() as one, pool.environment() as two:
            expected = [env.touch(sphere, np.eye(4)).force.tobytes() for env in (one, two)]
        schema = parse(where).environment
        ended = admin.execute(
            "SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity"
            " WHERE application_name = 'hapticdb' AND datname = current_database()"
            " AND pid <> pg_backend_pid()"
        ).fetchall()
        assert len(ended) >= 2, schema
        with pool.environment() as one, pool.environment() as two:
            assert [env.touch(sphere, np.eye(4)).force.tobytes() for env in (one, two)] == expected
