"""An environment on two shards, of which the second has a standby, for tests."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import contextlib
import itertools
from collections.abc import Iterator
from urllib.parse import parse_qs, quote, urlsplit

import numpy as np
import psycopg
import pytest
from numpy.typing import NDArray

from hapticdb import Grid
from hapticdb.store.connect import create_store, open_store
from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.testing import write_voxels
from realtime.worlds import SIZE
from sharded import ShardedServers, sharded
from standbys import Pair, pair  # noqa: F401 - a fixture

GRID = Grid(SIZE, (-64 * SIZE,) * 3, 7)
LOW, HIGH = np.array([[1, 2, 3]]), np.array([[120, 121, 122]])
numbers = itertools.count()


def host_of(server: PrivateServer) -> str:
    (host,) = parse_qs(urlsplit(server.conninfo()).query)["host"]
    return host


class Spread:
    """An environment whose second shard has a standby; the first shard has none."""

    def __init__(self, servers: ShardedServers, pair: Pair) -> None:
        self.servers, self.pair = servers, pair
        self.name = f"test_standbys_{next(numbers)}"
        self.hosts = [servers.hosts[0], f"{host_of(pair.primary)}|{host_of(pair.standby)}"]

    @property
    def url(self) -> str:
        """The environment, without its shards."""
        return with_environment(self.servers.url, self.name)

    @property
    def url_of_standbys(self) -> str:
        """The same, read from standbys where there are any."""
        return f"{self.url}&target_session_attrs=prefer-standby"

    def make(self) -> None:
        """Make it with an object on each shard, and wait until the standby has it."""
        there = ",".join(quote(host, safe="") for host in self.hosts)
        with contextlib.closing(create_store(f"{self.url}&shards={there}", GRID)) as store:
            write_voxels(store, LOW, "low")
            write_voxels(store, HIGH, "high")
        self.pair.await_replay()

    def write(self, name: str, voxels: NDArray[np.int64] = HIGH) -> None:
        """Write one more object, by default on the second shard."""
        with contextlib.closing(open_store(self.url)) as store:
            write_voxels(store, voxels, name)


@pytest.fixture
def spread(pair: Pair) -> Iterator[Spread]:
    """Two shards, once for each version found; all servers run again at the end."""
    made = Spread(sharded(pair.primary.binaries), pair)
    made.make()
    yield made
    made.pair.primary.start()
    with contextlib.suppress(psycopg.Error):
        made.pair.resume(made.pair.standby)
    for server in (made.servers.coordinator, made.servers.shards[0], pair.primary):
        with psycopg.connect(server.conninfo(), autocommit=True) as connection:
            connection.execute("SET client_min_messages = warning")
            connection.execute(f'DROP SCHEMA IF EXISTS "{made.name}" CASCADE'.encode())
