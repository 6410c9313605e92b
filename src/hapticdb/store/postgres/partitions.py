"""Partitions: the tables of rows on other servers, by ranges of their keys.

The table of a layout's rows is partitioned; each partition is a foreign table of `postgres_fdw` in
a schema of the environment's name on another server. Objects, surfaces and the log of changes stay
on the environment's own server.

A partition's ends lie between cells of 32 x 32 x 32 voxels. postgres_fdw commits on the partitions
before the environment commits; a crash in between leaves orphan rows, which no frame reads
(`tables/statements`) and `check --repair` removes.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from psycopg import errors, sql

from hapticdb.errors import AccessError, EnvironmentExistsError, UsageError
from hapticdb.grid import Grid
from hapticdb.store.base import CELL_SHIFT, Layout, row_shift
from hapticdb.store.postgres.address import Address, partition_addresses
from hapticdb.store.postgres.connecting.server_connection import ServerConnection

SCHEMA = Path(__file__).with_name("schema.sql").read_text(encoding="utf-8")
"""Creates all tables and functions of an environment, in its schema."""
SIZE = """
CREATE VIEW size AS
SELECT coalesce(sum(pg_total_relation_size(oid)) FILTER (WHERE relkind = 'r'), 0)::bigint AS bytes,
       coalesce(sum(pg_relation_size(oid)) FILTER (WHERE relname = {index}), 0)::bigint
         / current_setting('block_size')::int AS pages
  FROM pg_class
 WHERE relnamespace = quote_ident({name})::regnamespace"""
"""View on a partition: bytes of tables and indexes, pages of the rows' index."""
SERVER = """
CREATE SERVER {server} FOREIGN DATA WRAPPER postgres_fdw
OPTIONS (host {host}, port {port}, dbname {database}, async_capable 'true', fetch_size '10000',
         batch_size '1000')"""
PARTITION = """
CREATE FOREIGN TABLE {partition} PARTITION OF {table} FOR VALUES FROM ({low}) TO ({high})
SERVER {server} OPTIONS (schema_name {schema}, table_name {name})"""
SERVERS = """
SELECT DISTINCT srvname::text
  FROM pg_foreign_table JOIN pg_class ON pg_class.oid = ftrelid
  JOIN pg_foreign_server ON pg_foreign_server.oid = ftserver
 WHERE relnamespace = quote_ident(%s)::regnamespace AND srvname LIKE %s"""
"""Foreign servers of an environment, from `create_partitions`."""


def ends(grid: Grid, layout: Layout, n: int) -> list[int]:
    """First keys (n - 1,) of all but the first of n partitions, on cells if possible."""
    shift = row_shift(layout)
    # this many bits leave at least one cell for each partition; else ends lie between rows
    within = CELL_SHIFT if 3 * grid.bits >= CELL_SHIFT + n.bit_length() else shift
    cells = 1 << max(3 * grid.bits - within, 0)
    if cells < n:
        raise UsageError(
            f"a grid of {grid.bits} bits has {cells} rows of the table {layout}, too few for {n} "
            "partitions: give fewer partitions, or more bits"
        )
    # in keys of rows, which on bricks lack the bits of the voxel
    return [(cells * i // n) << (within - shift) for i in range(1, n)]


def _statements(table: Layout) -> list[str]:
    """Statements of a table's section of `SCHEMA`."""
    found = re.search(rf"^-- ## {table}$(.*?)(?=^-- ## )", SCHEMA, re.MULTILINE | re.DOTALL)
    assert found is not None  # noqa: S101 - the file has a section for each table
    return found[1].split(";")[:-1]


def create_partitions(
    address: Address,
    connect: Callable[[Address], ServerConnection],
    grid: Grid,
    layout: Layout,
) -> "Callable[[ServerConnection], None]":
    """Create the partitions of a new environment; returns the rest, for its own transaction."""
    partitions = partition_addresses(address)
    if not partitions:
        return lambda _: None
    # refuses a grid too small for its partitions before anything is created
    ends(grid, layout, len(partitions))
    made: list[ServerConnection] = []
    try:
        for partition in partitions:
            # noted before the write: `_undo` must also drop a partition that is half made
            made.append(connect(partition))
            made[-1].write(lambda: _make_partition(made[-1], layout))
    except BaseException:
        _undo(made)
        raise

    # no two-phase commit: the partitions are committed before, and dropped if the rest fails
    def join(connection: ServerConnection) -> None:
        try:
            _join(connection, made, grid, layout)
        except BaseException:
            _undo(made)
            raise
        for one in made:
            one.close()

    return join


def drop(connection: ServerConnection, connect: Callable[[Address], ServerConnection]) -> None:
    """Delete an environment's foreign servers, and the partitions in its address."""
    name = connection.address.environment
    for (server,) in connection.rows(SERVERS, (name, _server_name(name, "%"))):
        drop_server = sql.SQL("DROP SERVER {} CASCADE").format(sql.Identifier(server))
        connection.write(lambda text=drop_server: connection.execute(text))  # type: ignore[misc]
    _undo([connect(one) for one in partition_addresses(connection.address)])


def _server_name(environment: str, number: object) -> str:
    return f"hapticdb {environment} {number}"


def drop_schema(connection: ServerConnection) -> None:
    """Delete the environment's schema on one server."""
    schema = sql.Identifier(connection.address.environment)
    text = sql.SQL("DROP SCHEMA IF EXISTS {} CASCADE").format(schema)
    connection.write(lambda: connection.execute(text))


def _undo(made: Sequence[ServerConnection]) -> None:
    for one in made:
        drop_schema(one)
        one.close()


def _make_partition(connection: ServerConnection, layout: Layout) -> None:
    """Create a partition's schema and tables, inside a transaction."""
    name = connection.address.environment
    try:
        connection.execute(sql.SQL("CREATE SCHEMA {}").format(sql.Identifier(name)))
    except errors.DuplicateSchema as error:
        raise EnvironmentExistsError(
            f"{connection.shown}: schema {name!r} exists already on this partition; name another "
            "environment with ?environment=NAME, or drop it there"
        ) from error
    for statement in _statements(layout):
        connection.execute(statement)
    index = sql.Literal(f"{layout}_key")
    connection.execute(sql.SQL(SIZE).format(name=sql.Literal(name), index=index))


def _join(
    connection: ServerConnection, made: Sequence[ServerConnection], grid: Grid, layout: Layout
) -> None:
    """Replace the table of rows by a partitioned one, inside the environment's transaction."""
    schema = connection.address.environment
    try:
        if not connection.execute(
            "SELECT 1 FROM pg_extension WHERE extname = 'postgres_fdw'"
        ).fetchone():
            connection.execute("CREATE EXTENSION postgres_fdw")
        servers = [_make_server(connection, one, n) for n, one in enumerate(made)]
    except errors.InsufficientPrivilege as error:
        raise AccessError(
            f"{connection.shown}: this user may not use postgres_fdw; a superuser can allow it "
            "with 'CREATE EXTENSION postgres_fdw' and 'GRANT USAGE ON FOREIGN DATA WRAPPER "
            "postgres_fdw TO ...'"
        ) from error
    # one parent of the partitions' views: a single query sums the sizes on all servers
    connection.execute("CREATE TABLE size (bytes bigint, pages bigint)")
    for n, server in enumerate(servers):
        inherits = sql.SQL(
            "CREATE FOREIGN TABLE {} () INHERITS (size) SERVER {}"
            " OPTIONS (schema_name {}, table_name 'size')"
        )
        place = sql.Identifier(f"size_{n}"), server, sql.Literal(schema)
        connection.execute(inherits.format(*place))
    connection.execute(f"DROP TABLE {layout}")
    for statement in _statements(layout):
        # PostgreSQL allows no unique index on a table with foreign partitions
        if "CREATE UNIQUE INDEX" not in statement:
            by_range = re.sub(r"WITH \(.*\)", "PARTITION BY RANGE (z_val)", statement)
            connection.execute(by_range)
    limits = ["MINVALUE", *map(str, ends(grid, layout, len(made))), "MAXVALUE"]
    for n, server in enumerate(servers):
        connection.execute(
            sql.SQL(PARTITION).format(
                partition=sql.Identifier(f"{layout}_{n}"),
                table=sql.Identifier(layout),
                low=sql.SQL(limits[n]),
                high=sql.SQL(limits[n + 1]),
                server=server,
                schema=sql.Literal(schema),
                name=sql.Literal(layout),
            )
        )
    connection.execute(f"SELECT count(*) FROM {layout}")  # reaches each partition, or fails now


def _make_server(
    connection: ServerConnection, partition: ServerConnection, number: int
) -> sql.Identifier:
    """Create a foreign server, one login for all roles; only this owner may use it in tables."""
    info = partition.driver.info
    server = sql.Identifier(_server_name(connection.address.environment, number))
    place = {"host": info.host, "port": str(info.port), "database": info.dbname}
    values = {name: sql.Literal(value) for name, value in place.items()}
    try:
        connection.execute(sql.SQL(SERVER).format(server=server, **values))
    except errors.DuplicateObject as error:
        raise EnvironmentExistsError(
            f"{connection.shown}: the server {server.as_string()} is left from an environment of "
            "this name: drop it with DROP SERVER ... CASCADE"
        ) from error
    login = {"user": info.user, "password_required": "false"}
    if info.password:
        login = {"user": info.user, "password": info.password}
    elif connection.execute("SHOW is_superuser").fetchone() != ("on",):
        raise UsageError(
            f"{partition.shown}: only a superuser may use a partition without a password: give "
            "one in the partition's URL, or in ~/.pgpass"
        )
    pairs = [sql.SQL("{} {}").format(sql.Identifier(k), sql.Literal(v)) for k, v in login.items()]
    text = sql.SQL("CREATE USER MAPPING FOR PUBLIC SERVER {} OPTIONS ({})")
    connection.execute(text.format(server, sql.SQL(", ").join(pairs)))
    return server
