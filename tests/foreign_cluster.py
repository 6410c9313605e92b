"""A coordinator and three shards for tests: databases of one server, filled by hand."""

import os
import uuid
from collections.abc import Iterator
from typing import NamedTuple

import psycopg
import pytest
from psycopg import conninfo, sql

import hapticdb
from hapticdb import Grid
from hapticdb.store.base import CELL_SHIFT
from hapticdb.store.postgres import schema_of
from hapticdb.store.postgres.address import parse, with_environment
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards import foreign
from hapticdb.store.postgres.shards.foreign import ForeignPlace

GRID = Grid(0.005, (0, 0, 0), 8)
ENVIRONMENT = "sharded plant"  # a name that needs quotes
N_SHARDS = 3
CELLS = 30
"""Cells that tests use: keys below 30 * 2^15."""
CELL_KEYS = 1 << CELL_SHIFT
EQUAL_BORDERS = [0, 10, 20]
TOKEN = uuid.uuid4()
COORDINATOR = """
CREATE TABLE distribution (id integer PRIMARY KEY, token uuid, epoch bigint);
CREATE TABLE shard (number integer PRIMARY KEY, host text, first_key bigint, writes bigint);
CREATE TABLE live (id bigint PRIMARY KEY, version bigint, ranges bigint[], revision bigint);
CREATE TABLE plain (z_val bigint, id bigint, occupancy bytea)"""
SHARD = """
CREATE TABLE mark (token uuid, writes bigint, swept bigint, moved bigint);
CREATE TABLE {table} (z_val bigint NOT NULL, id bigint NOT NULL, {payload} version bigint NOT NULL);
CREATE UNIQUE INDEX {table}_key ON {table} (z_val, id, version)"""
Kept = tuple[int, int, int]
"""A row: key of a brick, object, version."""


class Cluster(NamedTuple):
    """A coordinator and its shards: databases of one server."""

    coordinator: ServerConnection
    shards: list[psycopg.Connection]
    places: dict[int, ForeignPlace]

    def align(self, borders: list[int]) -> None:
        """Set the first cell of each shard, and bring the foreign tables in line."""

        def work() -> None:
            self.coordinator.execute("DELETE FROM shard")
            for n, first in enumerate(borders, 1):
                self.coordinator.execute(
                    "INSERT INTO shard VALUES (%s, %s, %s, 0)", (n, str(n), first * CELL_KEYS)
                )
            foreign.align(self.coordinator, "brick", self.places)

        self.coordinator.write(work)

    def live(self, versions: dict[int, int]) -> None:
        self.coordinator.execute("DELETE FROM live")
        for number, version in versions.items():
            self.coordinator.execute("INSERT INTO live VALUES (%s, %s, '{}', 1)", (number, version))

    def keep(self, shard: int, rows: list[Kept]) -> None:
        """Replace the rows of a shard, counted from 0."""
        self.shards[shard].execute("TRUNCATE brick, mark")
        self.shards[shard].execute("INSERT INTO mark VALUES (%s, 0, 0, 0)", (TOKEN,))
        if rows:
            self.shards[shard].execute(
                "INSERT INTO brick"
                " SELECT z, id, decode(lpad(to_hex(mod(z, 65536)), 128, '1'), 'hex'), version"
                " FROM unnest(%s::bigint[], %s::bigint[], %s::bigint[])"
                " AS r(z, id, version)",
                tuple(list(column) for column in zip(*rows, strict=True)),
            )


def base_of(url: str, name: str) -> str:
    """Words for libpq that lead to another database of that server."""
    return conninfo.make_conninfo(parse(url).conninfo, dbname=name)


@pytest.fixture(scope="module")
def cluster(database: str) -> Iterator[Cluster]:
    names = [f"test_shards_{os.getpid()}_{n}" for n in range(N_SHARDS + 1)]
    with psycopg.connect(parse(database).conninfo, autocommit=True) as admin:
        for name in names:
            admin.execute(sql.SQL("CREATE DATABASE {}").format(sql.Identifier(name)))
        head, _, query = database.partition("?")
        url = with_environment(f"{head.rpartition('/')[0]}/{names[0]}?{query}", ENVIRONMENT)
        hapticdb.create(url, GRID, distances=False).close()
        coordinator = schema_of.connected(url)
        coordinator.command(COORDINATOR)
        coordinator.execute("INSERT INTO distribution VALUES (1, %s, 0)", (TOKEN,))
        coordinator.command(foreign.CUSTOM_PLANS)
        shards, places = [], {}
        for n, name in enumerate(names[1:], 1):
            there = base_of(database, name)
            shards.append(psycopg.connect(there, autocommit=True))
            make_shard(shards[-1])
            words = conninfo.conninfo_to_dict(there)
            user: dict[str, str] = {
                key: str(words.pop(key)) for key in ("user", "password") if key in words
            }
            places[n] = ForeignPlace({key: str(value) for key, value in words.items()}, user)
        yield Cluster(coordinator, shards, places)
        coordinator.close()
        for shard in shards:
            shard.close()
        for name in names:
            admin.execute(sql.SQL("DROP DATABASE {} WITH (FORCE)").format(sql.Identifier(name)))


def make_shard(shard: psycopg.Connection) -> None:
    shard.execute(sql.SQL("CREATE SCHEMA {}").format(sql.Identifier(ENVIRONMENT)))
    shard.execute(sql.SQL("SET search_path = {}").format(sql.Identifier(ENVIRONMENT)))
    shard.execute(SHARD.format(table="brick", payload="occupancy bytea NOT NULL,"))
    for table, payload in (("band", "distances bytea NOT NULL,"), ("voxel", "")):
        shard.execute(SHARD.partition(";")[2].format(table=table, payload=payload))
    for statements_there in foreign.SHARD_VIEWS.values():
        for statement in statements_there:
            shard.execute(statement)


def spread(cells: range = range(CELLS)) -> list[Kept]:
    """Some rows in each cell, of three objects, all of version 100 + id."""
    return [(64 * cell + 7 * n, 1 + n % 3, 101 + n % 3) for cell in cells for n in range(9)]


@pytest.fixture
def filled(cluster: Cluster) -> Cluster:
    """Borders at cells 10 and 20, rows in every cell, all of which count."""
    cluster.live({1: 101, 2: 102, 3: 103})
    cluster.coordinator.execute("UPDATE distribution SET epoch = 0")
    for n, first in enumerate(EQUAL_BORDERS):
        cluster.keep(n, spread(range(first, first + 10)))
    cluster.align(EQUAL_BORDERS)
    return cluster
