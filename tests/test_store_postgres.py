"""PostgreSQL passes the contract, and what is only PostgreSQL's."""

import numpy as np
import psycopg
import pytest

import hapticdb
from hapticdb import Grid
from hapticdb.store.base import Layout, Store
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.store import PostgresStore
from hapticdb.testing import StoreContract, blob, floor_voxels, write_voxels
from servers import Place

GRID = Grid(0.005, (0, 0, 0), 6)


class TestPostgresStore(StoreContract):
    @pytest.fixture(autouse=True)
    def _place(self, place: Place) -> None:
        self.place = place
        self.urls: dict[str, str] = {}

    def make(self, grid: Grid, layout: Layout, name: str = "environment") -> Store:
        self.urls[name] = self.place()
        return PostgresStore.create(self.urls[name], grid, layout)

    def reopen(self, store: Store) -> Store:
        return PostgresStore.open(store.url, read_only=True)


@pytest.fixture
def url(place: Place) -> str:
    """A small environment, closed."""
    where = place()
    store = PostgresStore.create(where, GRID)
    write_voxels(store, floor_voxels(GRID))
    store.close()
    return where


def test_creating_never_replaces_an_environment(url: str) -> None:
    with pytest.raises(hapticdb.EnvironmentExistsError, match="exists already"):
        hapticdb.create(url, GRID)
    with hapticdb.open(url) as env:
        assert len(env.objects()) == 1


def test_what_is_not_there_is_told(place: Place) -> None:
    with pytest.raises(hapticdb.EnvironmentNotFoundError, match="hapticdb import"):
        hapticdb.open(place())


def test_a_foreign_schema_is_told_apart_and_left_alone(
    place: Place, admin: psycopg.Connection
) -> None:
    where = place()
    name = parse(where).environment
    admin.execute(f"CREATE SCHEMA {name} CREATE TABLE theirs (a int)")
    with pytest.raises(hapticdb.NotAnEnvironmentError, match="no hapticdb environment"):
        hapticdb.open(where)
    with pytest.raises(hapticdb.EnvironmentExistsError):
        hapticdb.create(where, GRID)
    assert admin.execute(f"SELECT count(*) FROM {name}.theirs").fetchone() == (0,)


def test_a_newer_format_is_refused(url: str, admin: psycopg.Connection) -> None:
    admin.execute(f"UPDATE {parse(url).environment}.environment SET format = 99")
    with pytest.raises(hapticdb.NewerVersionError, match="install a newer"):
        hapticdb.open(url)


def test_a_dropped_table_is_damage(url: str, admin: psycopg.Connection) -> None:
    admin.execute(f"DROP TABLE {parse(url).environment}.brick")
    with pytest.raises(hapticdb.DamagedError, match="is damaged"):
        hapticdb.open(url, read_only=True).store.lookup(np.arange(9))


def test_a_read_only_environment_refuses_to_be_written(url: str) -> None:
    env = hapticdb.open(url, read_only=True)
    with pytest.raises(hapticdb.ReadOnlyError, match="opened to read"):
        env.remove(1)
    with pytest.raises(hapticdb.ReadOnlyError):
        env.store.save_costs("here", {})


def test_no_other_thread_may_use_it(url: str) -> None:
    from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415

    env = hapticdb.open(url, read_only=True)
    with ThreadPoolExecutor(1) as pool, pytest.raises(hapticdb.UsageError, match="thread"):
        pool.submit(env.objects).result()


def test_rows_that_come_without_an_index_are_sorted(url: str, admin: psycopg.Connection) -> None:
    store = PostgresStore.open(url)
    for n in range(3):
        write_voxels(store, blob(n, (30, 30, 30)), f"blob {n}")
    everywhere = [np.array([b], dtype=np.int64) for b in (0, 2**62)]
    before = store.scan(*everywhere)
    admin.execute(f"DROP INDEX {parse(url).environment}.brick_key")
    for found, expected in zip(store.scan(*everywhere), before, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_left_out_index_is_made_when_it_is_opened_to_write(
    url: str, admin: psycopg.Connection
) -> None:
    name = parse(url).environment
    admin.execute(f"DROP INDEX {name}.brick_key")
    hapticdb.open(url, read_only=True).close()
    assert admin.execute("SELECT to_regclass(%s)", (f"{name}.brick_key",)).fetchone() == (None,)
    hapticdb.open(url).close()
    assert admin.execute("SELECT to_regclass(%s)", (f"{name}.brick_key",)).fetchone() != (None,)
