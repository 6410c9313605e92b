"""A coordinator and three shards that tests run against: four private servers of each version.

The coordinator is the server of `servers.private_server`. The shards start when they are first
needed, all at once, and stop at the end. With HAPTICDB_TEST_POSTGRES_URL, which names one server
only, the coordinator is a private server, too.
"""

import atexit
import itertools
import os
import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import NamedTuple
from urllib.parse import parse_qs, quote, urlsplit

import psycopg
import pytest
from psycopg import sql

from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.private_server import Binaries, PrivateServer, find_binaries
from servers import FOUND, SETTINGS, Place, named
from steps import MOST_STEPS

N_SHARDS = 3
SHARD_SETTINGS = {**SETTINGS, "shared_buffers": "16MB"}
"""Settings of a shard: the coordinator's with less memory."""
SHARDED_FOUND = [found for found in FOUND if isinstance(found, Binaries)] or find_binaries()
_numbers = itertools.count()


class ShardedServers(NamedTuple):
    """The servers of a sharded environment. A test that stops one starts it again at its end.

    coordinator : has the catalogue; shards : have the rows; hosts : of the shards, as the catalogue
    has them (folders of their sockets); url : the database on the coordinator, without shards.
    """

    coordinator: PrivateServer
    shards: tuple[PrivateServer, ...]

    @property
    def hosts(self) -> tuple[str, ...]:
        queries = (urlsplit(shard.conninfo()).query for shard in self.shards)
        return tuple(parse_qs(query)["host"][0] for query in queries)

    @property
    def url(self) -> str:
        return self.coordinator.conninfo()

    @property
    def steps_tried(self) -> range:
        """Steps before which a test of all steps kills something: of older versions every 5th.

        The steps are the client's, the same on each version. 5 goes through every kind of edit,
        and through odd and even steps.
        """
        is_newest = self.coordinator.binaries.major == SHARDED_FOUND[0].major
        return range(1, MOST_STEPS, 1 if is_newest else 5)

    def url_of(self, environment: str) -> str:
        """URL that makes an environment of that name on these shards."""
        hosts = ",".join(quote(host, safe="") for host in self.hosts)
        return with_environment(f"{self.url}&shards={hosts}", environment)


@cache
def sharded(found: Binaries) -> ShardedServers:
    """Running servers of one version for all tests of this process."""
    assert SHARDED_FOUND, "no PostgreSQL found: install the extra postgres"
    folder = Path(tempfile.mkdtemp(prefix="hapticdb-shards-"))
    shards: list[PrivateServer] = []

    def end() -> None:
        for shard in shards:
            shard.stop()
        shutil.rmtree(folder, ignore_errors=True)

    def started(number: int) -> PrivateServer:
        shard = PrivateServer.at(folder / str(number), found, SHARD_SETTINGS)
        shards.append(shard)
        shard.start()
        return shard

    atexit.register(end)
    coordinator = started(0)
    with ThreadPoolExecutor(N_SHARDS) as pool:
        return ShardedServers(coordinator, tuple(pool.map(started, range(1, N_SHARDS + 1))))


@pytest.fixture(scope="session", params=SHARDED_FOUND, ids=named)
def sharded_servers(request: pytest.FixtureRequest) -> ShardedServers:
    """A coordinator and three shards, once for each version found."""
    assert isinstance(request.param, Binaries)
    return sharded(request.param)


@pytest.fixture
def sharded_place(sharded_servers: ShardedServers) -> Iterator[Place]:
    """Like `place`, on a coordinator and three shards; the schemas are dropped on all of them."""
    given: list[str] = []

    def new() -> str:
        given.append(f"test_{os.getpid()}_sharded_{next(_numbers)}")
        return sharded_servers.url_of(given[-1])

    yield new
    for server in (sharded_servers.coordinator, *sharded_servers.shards):
        server.start()  # a test may have stopped it
        with psycopg.connect(server.conninfo(), autocommit=True) as connection:
            connection.execute("SET client_min_messages = warning")
            for name in given:
                drop = sql.SQL("DROP SCHEMA IF EXISTS {} CASCADE").format(sql.Identifier(name))
                connection.execute(drop)
