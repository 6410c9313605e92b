"""PostgreSQL passes the contract suite; tests of what only PostgreSQL does."""

import contextlib
import re
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import psycopg
import pytest
from psycopg import conninfo

import hapticdb
from children import TIMEOUT
from contract.store import StoreContract
from hapticdb import Grid
from hapticdb.errors import DatabaseError
from hapticdb.paper.quantiles import DEFAULT_RESOLUTION
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.postgres_store import PostgresStore
from hapticdb.store.postgres.tables import statements
from hapticdb.store.postgres.tables.server_tables import SERVER_RESOLUTION
from servers import Place
from voxels import blob, everything, floor_voxels, write_voxels

GRID = Grid(0.005, (0, 0, 0), 6)


@pytest.fixture
def new_url(place: Place) -> Place:
    return place


class TestPostgresStore(StoreContract):
    pass


@pytest.fixture
def url(place: Place) -> str:
    """URL of a small environment that no store has open."""
    where = place()
    store = PostgresStore.create(where, GRID)
    write_voxels(store, floor_voxels(GRID))
    store.close()
    return where


def test_open_foreign_schema_untouched(place: Place, admin: psycopg.Connection) -> None:
    where = place()
    name = parse(where).environment
    admin.execute(f"CREATE SCHEMA {name} CREATE TABLE theirs (a int)")
    with pytest.raises(hapticdb.errors.NotAnEnvironmentError, match="no hapticdb environment"):
        hapticdb.open(where)
    with pytest.raises(hapticdb.errors.EnvironmentExistsError):
        hapticdb.create(where, GRID)
    assert admin.execute(f"SELECT count(*) FROM {name}.theirs").fetchone() == (0,)


def test_open_other_format(url: str, admin: psycopg.Connection) -> None:
    name = parse(url).environment
    admin.execute(f"CREATE TABLE {name}.band (z_val bigint)")
    with pytest.raises(hapticdb.errors.NotAnEnvironmentError, match=r"made before 0\.1; import"):
        hapticdb.open(url)
    admin.execute(f"DROP TABLE {name}.band")
    table = f"{name}.environment"
    admin.execute(f"UPDATE {table} SET version = 99")
    with pytest.raises(hapticdb.errors.NewerVersionError, match="install a newer"):
        hapticdb.open(url)
    admin.execute(f"ALTER TABLE {table} RENAME version TO format")
    with pytest.raises(hapticdb.errors.NotAnEnvironmentError, match=r"made before 0\.1; import"):
        hapticdb.open(url)


def test_lookup_dropped_table_is_damage(url: str, admin: psycopg.Connection) -> None:
    admin.execute(f"DROP TABLE {parse(url).environment}.brick")
    with pytest.raises(hapticdb.errors.DamagedError, match="is damaged"):
        hapticdb.open(url, read_only=True).store.lookup(np.arange(9))


def test_open_recreates_missing_index(url: str, admin: psycopg.Connection) -> None:
    with hapticdb.open(url) as env:
        for n in range(3):
            write_voxels(env.store, blob(n, (30, 30, 30)), f"blob {n}")
        before = everything(env.store)
    name = f"{parse(url).environment}.brick_key"
    admin.execute(f"DROP INDEX {name}")
    with hapticdb.open(url, read_only=True) as env:
        for found, expected in zip(everything(env.store), before, strict=True):
            np.testing.assert_array_equal(found, expected)
    assert admin.execute("SELECT to_regclass(%s)", (name,)).fetchone() == (None,)
    hapticdb.open(url).close()
    assert admin.execute("SELECT to_regclass(%s)", (name,)).fetchone() != (None,)


def test_loading_two_loaders_end_together(place: Place) -> None:
    where = place()
    PostgresStore.create(where, GRID).close()
    barrier = threading.Barrier(2)

    def load(n: int) -> None:
        store = PostgresStore.open(where)
        with store.loading():
            write_voxels(store, blob(n, (30, 30, 30)), f"blob {n}")
            barrier.wait(TIMEOUT)
        store.close()

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(load, range(2), timeout=TIMEOUT))
    store = PostgresStore.open(where)
    assert len(store.objects()) == 2
    # no advisory lock of a loader remains, so that the next killed import can be repaired
    free = store._connection.rows(
        "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND classid::bigint = %s"
        " AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
        " AND objid::bigint = ('environment'::regclass::oid::bigint + 2147483648) %% 4294967296",
        (0x48415054,),
    )
    assert free == [(0,)]


@pytest.mark.parametrize("is_loading", [False, True])
def test_discard_refused_while_others_write(place: Place, is_loading: bool) -> None:
    where = place()
    first = PostgresStore.create(where, GRID)
    second = PostgresStore.open(where)
    with contextlib.ExitStack() as loading:
        if is_loading:
            loading.enter_context(second.loading())
        else:
            write_voxels(second, blob(1, (30, 30, 30)), "before")
        first.discard()
        write_voxels(second, blob(1, (30, 30, 30)), "after")
    assert second.objects()[-1].name == "after"


@pytest.mark.parametrize("name", ["a%24%24b", "pg_mine", "public", "", "a%0Ab", "x\udcff"])
def test_create_bad_environment_name(database: str, name: str) -> None:
    where = f"{database}{'&' if '?' in database else '?'}environment={name}"
    with pytest.raises(hapticdb.errors.UsageError, match="environment's name"):
        hapticdb.create(where, GRID)


def test_statement_tiny_normals_equal_kernels(url: str) -> None:
    """Products that underflow must not fail, though PostgreSQL raises an error for them."""
    env = hapticdb.open(url, read_only=True)
    center = GRID.centers(np.array([[32, 32, 31]]))[0]
    shell = hapticdb.PointShell(
        np.array([[0, 0, -0.001], [0, 1e-200, -0.002]]),
        np.array([[5e-324, -1e-160, 1.0], [1e-120, 0.0, 1.0]]),
        np.array([0, 0, 1e-250]),
    )
    pose = np.eye(4)
    pose[:3, 3] = center
    by_kernel = env.touch(shell, pose, "array")
    by_server = env.touch(shell, pose, "statement")
    assert len(by_kernel.hits) == 2
    assert by_kernel.force.tobytes() == by_server.force.tobytes()
    assert by_kernel.torque.tobytes() == by_server.torque.tobytes()


def test_create_other_encoding(place: Place, admin: psycopg.Connection) -> None:
    admin.execute("DROP DATABASE IF EXISTS other_encoding")
    admin.execute(
        "CREATE DATABASE other_encoding ENCODING 'SQL_ASCII' LOCALE 'C' TEMPLATE template0"
    )
    known = conninfo.conninfo_to_dict(admin.info.dsn)["dbname"]
    where = place().replace(f"/{known}?", "/other_encoding?")
    with hapticdb.create(where, GRID) as env:
        write_voxels(env.store, blob(1, (30, 30, 30)), "中")
        assert [obj.name for obj in env.objects()] == ["中"]
    admin.execute("DROP DATABASE other_encoding")


FINER = Grid(0.005, (0, 0, 0), 8)


@pytest.fixture
def large(place: Place) -> hapticdb.Environment:
    """Two objects of together 130,000 voxels, some of them shared, in the voxel layout."""
    env = hapticdb.create(place(), FINER, layout="voxel")
    rng = np.random.default_rng(5)
    with env.store.loading():
        for n, center in enumerate((100, 110)):
            drawn = np.unique(rng.normal(center, 22, (70_000, 3)).astype(np.int64), axis=0)
            inside = drawn[((drawn >= 0) & (drawn < 256)).all(axis=1)]
            write_voxels(env.store, inside, f"cloud {n}")
    env.store.analyze(DEFAULT_RESOLUTION)
    return env


def test_quantiles_default_from_server_statistics(large: hapticdb.Environment) -> None:
    served = large.quantiles()
    assert served.source == "server statistics"
    assert served.resolution == DEFAULT_RESOLUTION == SERVER_RESOLUTION
    keys = np.sort(large.store.scan(*(np.array([b]) for b in (0, 2**62))).keys)
    assert served.n_rows == pytest.approx(len(keys), rel=0.01)
    # a bucket holds 13 rows; each bound is within three buckets of its rank
    ranks = np.searchsorted(keys, served.bounds) / len(keys)
    error = np.abs(ranks - np.arange(SERVER_RESOLUTION + 1) / SERVER_RESOLUTION)
    assert error.max() <= 3 / SERVER_RESOLUTION
    assert large.quantiles(1000).source == "computed"


@pytest.mark.parametrize("form", ["lookup", "scan"])
def test_frames_index_only_scan(
    large: hapticdb.Environment, admin: psycopg.Connection, form: str
) -> None:
    """No heap page is fetched: the visibility map is set after loading."""
    name = parse(large.url).environment
    keys = large.quantiles(300).bounds
    text = {"lookup": statements.LOOKUP, "scan": statements.SCAN}[form]["voxel"]
    arrays = [keys.tolist()] if form == "lookup" else [keys[::2].tolist(), keys[1::2].tolist()]
    if form == "scan":
        arrays[0] = arrays[0][: len(arrays[1])]
    admin.execute(f"SET search_path = {name}")
    admin.execute("SET plan_cache_mode = force_generic_plan")
    admin.execute("SET enable_seqscan = off")
    admin.execute("SET enable_bitmapscan = off")
    types = ", ".join(["bigint[]"] * len(arrays))
    admin.execute(f"PREPARE frame({types}) AS {text}")
    values = ", ".join(f"'{{{','.join(map(str, a))}}}'" for a in arrays)
    plan = [row[0] for row in admin.execute(f"EXPLAIN (ANALYZE, BUFFERS) EXECUTE frame({values})")]
    admin.execute("DEALLOCATE frame")
    shown = "\n".join(plan)
    assert "Index Only Scan using voxel_key" in shown
    assert re.findall(r"Heap Fetches: (\d+)", shown) == ["0"]


@pytest.mark.parametrize("reset", ["SET search_path TO {other}", "DISCARD ALL"])
def test_write_behind_transaction_pooler_refused(place: Place, reset: str) -> None:
    """A transaction there may have another search path, or none."""
    stores = [PostgresStore.create(place(), GRID, "brick") for _ in range(2)]
    for store in stores:
        write_voxels(store, floor_voxels(GRID), "floor")
    one, other = stores
    text = reset.format(other=parse(other.url).environment)
    one._connection.driver.execute(text)
    writes: list[Callable[[], object]] = [
        lambda: write_voxels(one, blob(1, (20, 20, 20)), "blob"),
        lambda: one.remove(1),
        lambda: one.save_costs("here", {}),
    ]
    for write in writes:
        with pytest.raises(DatabaseError, match="seems to be behind a pooler in transaction mode"):
            write()
    one.close()
    for store in (other, PostgresStore.open(one.url)):
        assert [obj.name for obj in store.objects()] == ["floor"]
        assert (store.revision(), store.costs("here")) == (1, None)
        write_voxels(store, blob(1, (20, 20, 20)), "blob")
        store.close()


def test_loading_behind_pooler_keeps_other_indexes(place: Place, admin: psycopg.Connection) -> None:
    one, other = (PostgresStore.create(place(), GRID, "brick") for _ in range(2))
    name = parse(other.url).environment
    one._connection.driver.execute(f"SET search_path TO {name}")
    with pytest.raises(DatabaseError, match="pooler in transaction mode"), one.loading():
        pass
    found = admin.execute("SELECT to_regclass(%s) IS NOT NULL", (f"{name}.brick_key",))
    assert found.fetchone() == (True,)
    one.close()
    other.close()
