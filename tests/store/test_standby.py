"""Reads from a standby, through a URL that names both servers and prefers the standby."""

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np
import psycopg
import pytest

import hapticdb
from children import until
from command_line import PLACES, Run, refused
from hapticdb import PointShell
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from hapticdb.session.prefetch.fetching import Fetcher, FetchRequest
from hapticdb.store.engines import MayLag
from hapticdb.store.postgres.postgres_store import PostgresStore
from postgres_servers import Server, serving
from servers import FOUND, SETTINGS, named
from voxels import is_noticed, write_voxels


class Pair(NamedTuple):
    """URLs of one environment: on the primary, on the standby alone, on both, preferring it."""

    primary: str
    standby: str
    both: str


@pytest.fixture(scope="module", params=FOUND[:1], ids=named)
def pair(request: pytest.FixtureRequest, made: Path) -> Iterator[Pair]:
    """A primary with an environment of three boxes, and a standby that has replayed it."""
    with contextlib.ExitStack() as ends:
        folder = Path(tempfile.mkdtemp(prefix="standby-")).resolve()
        ends.callback(shutil.rmtree, folder, ignore_errors=True)
        primary = ends.enter_context(serving(folder / "primary", request.param, SETTINGS))
        hapticdb.copy_environment(made / "scene.db", primary.conninfo())
        copy_server(primary, folder / "standby" / "data")
        standby = ends.enter_context(serving(folder / "standby", request.param, SETTINGS))
        urls = primary.conninfo(), standby.conninfo()
        hosts = ",".join(parse_qs(urlsplit(url).query)["host"][0] for url in urls)
        both = (
            f"postgresql:///postgres?host={hosts}&port=5432,5432&user=hapticdb"
            "&target_session_attrs=prefer-standby"
        )
        await_replay(Pair(*urls, both))
        yield Pair(*urls, both)


def copy_server(primary: Server, data: Path) -> None:
    words = ["--write-recovery-conf", "--checkpoint=fast", "--no-sync", f"--pgdata={data}"]
    primary.binaries.run("pg_basebackup", *words, f"--dbname={primary.conninfo()}")


def await_replay(pair: Pair) -> None:
    """Wait until the standby has replayed all that the primary has written now."""
    with (
        psycopg.connect(pair.primary, autocommit=True) as there,
        psycopg.connect(pair.standby, autocommit=True) as here,
    ):
        row = there.execute("SELECT pg_current_wal_flush_lsn()::text").fetchone()
        reached = "SELECT pg_last_wal_replay_lsn() >= %s::pg_lsn"
        until(lambda: here.execute(reached, row).fetchone() == (True,))


def test_standby_same_answers_as_primary(pair: Pair, sphere: PointShell) -> None:
    poses = np.tile(np.eye(4), (len(PLACES), 1, 1))
    poses[:, :3, 3] = PLACES
    with (
        hapticdb.open(pair.both, read_only=True) as here,
        hapticdb.open(pair.primary, read_only=True) as there,
    ):
        assert isinstance(here.store, PostgresStore)
        assert here.store._connection.rows("SELECT pg_is_in_recovery()") == [(True,)]
        assert [obj.name for obj in here.objects()] == [obj.name for obj in there.objects()]
        for strategy in STRATEGIES:
            found, expected = (
                [env.touch(sphere, pose, strategy, law="plane") for pose in poses]
                for env in (here, there)
            )
            assert any(touch.hits.size for touch in expected)
            for one, other in zip(found, expected, strict=True):
                np.testing.assert_array_equal(one.hits, other.hits)
                np.testing.assert_array_equal(
                    [*one.force, *one.torque], [*other.force, *other.torque]
                )


def test_standby_has_changed_follows_commits(pair: Pair) -> None:
    with contextlib.closing(PostgresStore.open(pair.both, read_only=True)) as reader:
        reader.watch()
        for n in range(3):
            assert not reader.has_changed()
            with contextlib.closing(PostgresStore.open(pair.primary)) as store:
                write_voxels(store, np.array([[1, 2, 3]]), f"{n}")
                revision = store.revision()
            assert is_noticed(reader)
            assert reader.revision() == revision


@pytest.mark.parametrize("is_standby", [True, False])
def test_standby_session_cells_and_lag(pair: Pair, *, is_standby: bool) -> None:
    url = pair.both if is_standby else pair.primary
    table = CellTable.create(LEAST_BUDGET)
    with hapticdb.open(url, read_only=True) as env:
        fetcher = Fetcher(FetchRequest(url, table, env.grid))
    try:
        assert isinstance(fetcher.store, MayLag)
        fetcher.warm_up()
        fetcher.round()
        assert bool(table.queue.figures["lag"] > 0) == is_standby
    finally:
        fetcher.close()
        table.close()


def test_standby_refuses_writes(pair: Pair, run: Run, made: Path) -> None:
    for url in (pair.both, pair.standby):
        for line in (
            ("import", url, made / "boxes.glb"),
            ("import", f"{url}&environment=other", made / "boxes.glb"),
            ("remove", url, 1),
            ("grant", url, "pg_monitor", "--as", "viewer"),
        ):
            refused(run(*line), "is a standby: it can only be read", "target_session_attrs=primary")
    assert run("info", pair.both, "--calibrate", "--json")[0] == 0
    at_primary = pair.both.replace("prefer-standby", "primary")
    assert run("remove", at_primary, 1)[0] == 0
