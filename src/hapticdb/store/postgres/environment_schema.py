"""Schema of an environment: creation, opening, checks, deletion."""

from psycopg import errors, sql

from hapticdb.errors import (
    AccessError,
    EnvironmentExistsError,
    EnvironmentNotFoundError,
    NotAnEnvironmentError,
    ReadOnlyError,
)
from hapticdb.grid import Grid
from hapticdb.store import parsing
from hapticdb.store.base import Layout
from hapticdb.store.postgres import partitions
from hapticdb.store.postgres.address import Address, parse
from hapticdb.store.postgres.connecting import failures
from hapticdb.store.postgres.connecting.server_connection import ServerConnection
from hapticdb.store.store_errors import FORMAT, check_format, made_before


def connected(url: str, *, read_only: bool = False) -> ServerConnection:
    """Connect to an environment's database. The environment itself may be missing."""
    return connect(parse(url), read_only=read_only)


def connect(address: Address, *, read_only: bool = False) -> ServerConnection:
    """Connect to a database; refuses to write to a standby."""
    found = ServerConnection(address, read_only=read_only)
    if found.is_standby and not read_only:
        found.close()
        raise failures.standby(address.shown)
    return found


def exists(url: str) -> bool:
    """Whether a schema of this name exists, an environment or not."""
    with connected(url, read_only=True) as connection:
        return _has_schema(connection)


def _has_schema(connection: ServerConnection) -> bool:
    return bool(
        connection.rows(
            "SELECT 1 FROM pg_namespace WHERE nspname = %s", (connection.address.environment,)
        )
    )


def opened(url: str, *, read_only: bool) -> ServerConnection:
    """Connect to an existing environment."""
    connection = connected(url, read_only=read_only)
    try:
        check(connection)
        if not read_only:
            _check_writable(connection)
    except BaseException:
        connection.close()
        raise
    return connection


def check(connection: ServerConnection) -> None:
    """Refuse a schema without an environment, of a newer format, or without the right to read."""
    shown, name = connection.shown, connection.address.environment
    if not _has_schema(connection):
        raise EnvironmentNotFoundError(
            f"no environment {name!r} at {shown}; make one with 'hapticdb import URL FILE'"
        )
    # from the catalog, which answers without any right on the schema
    found = connection.rows(
        "SELECT has_schema_privilege(n.oid, 'USAGE') AND has_table_privilege(c.oid, 'SELECT'),"
        "       ARRAY(SELECT attname::text FROM pg_attribute WHERE attrelid = c.oid)"
        "  FROM pg_class c JOIN pg_namespace n ON n.oid = c.relnamespace"
        " WHERE n.nspname = %s AND c.relname = 'environment'",
        (name,),
    )
    is_readable, columns = found[0] if found else (False, [])
    if "format" in columns:
        raise made_before(shown)
    if "version" not in columns:
        raise NotAnEnvironmentError(
            f"schema {name!r} at {shown} is no hapticdb environment; name another one with "
            "?environment=NAME"
        )
    if not is_readable:  # without the right, the server hides the schema
        raise AccessError(
            f"{shown}: this user may not read the environment {name!r}; its owner can allow it "
            "with 'hapticdb grant URL ROLE --as viewer'"
        )
    for (version,) in connection.rows("SELECT version FROM environment"):
        check_format(shown, version)


def _check_writable(connection: ServerConnection) -> None:
    """Refuse a user without any right to write, before minutes of work; a toucher has one."""
    if connection.rows("SELECT has_table_privilege('cost', 'INSERT')") != [(True,)]:
        raise ReadOnlyError(
            f"{connection.shown} can only be read by this user; its owner can allow more with "
            "'hapticdb grant URL ROLE --as editor'"
        )


TABLE_KINDS = """
SELECT relname::text, CASE relkind WHEN 'r' THEN 'table' WHEN 'p' THEN 'table' WHEN 'v' THEN 'view'
                      WHEN 'm' THEN 'materialized view' ELSE 'relation ' || relkind::text END
  FROM pg_class JOIN pg_namespace n ON n.oid = relnamespace
 WHERE nspname = %s AND relkind <> 'i'"""


def read_environment(connection: ServerConnection) -> tuple[Grid, Layout, bool, int, bool]:
    """Checked row of `environment`: grid, layout, and whether imports compute distances.

    Then its table's oid, and whether the rows are on partitions.
    """
    kinds = dict(connection.rows(TABLE_KINDS, (connection.address.environment,)))
    rows = connection.rows(
        "SELECT voxel_size, origin_x, origin_y, origin_z, bits, curve, layout,"
        " tableoid::bigint, wants_distances, (SELECT relkind = 'p' FROM pg_class"
        "  WHERE oid = to_regclass(layout)) FROM environment"
    )
    grid, layout = parsing.grid_of(connection.shown, rows)
    parsing.check_tables(connection.shown, kinds)
    wants = parsing.distances_wanted(connection.shown, rows[0][8])
    return grid, layout, wants, rows[0][7], bool(rows[0][9])


def created(url: str, grid: Grid, layout: Layout, *, distances: bool) -> None:
    """Create the partitions, then the schema with all tables and the grid, in one transaction."""
    with connected(url) as connection:
        name = connection.address.environment
        # early, since partitions are committed before the schema; `work` closes the race
        if connection.address.partitions and _has_schema(connection):
            raise _there_already(connection)
        spread = partitions.create_partitions(connection.address, connect, grid, layout)

        def work() -> None:
            try:
                connection.execute(sql.SQL("CREATE SCHEMA {}").format(sql.Identifier(name)))
            # UniqueViolation: another creator's commit of the same schema came in between
            except (errors.DuplicateSchema, errors.UniqueViolation) as error:
                raise _there_already(connection) from error
            except errors.InsufficientPrivilege as error:
                raise AccessError(
                    f"{connection.shown}: there is no environment {name!r}, and this user may not "
                    "make one; the database's owner can allow it with "
                    "'GRANT CREATE ON DATABASE ... TO ...'"
                ) from error
            connection.execute(partitions.SCHEMA)
            kept = grid.voxel_size, *grid.origin, grid.bits, grid.curve, layout, distances
            connection.execute(
                "INSERT INTO environment VALUES (1, %s, %s, %s, %s, %s, %s, %s, %s, %s, 0)",
                (FORMAT, *kept),
            )
            spread(connection)

        # the schema exists only if its transaction, with all tables, was committed
        connection.write(work, lambda: _has_schema(connection))


def _there_already(connection: ServerConnection) -> EnvironmentExistsError:
    return EnvironmentExistsError(
        f"{connection.shown}: schema {connection.address.environment!r} exists already; open it, "
        "or name another environment with ?environment=NAME"
    )


def drop(connection: ServerConnection) -> None:
    """Delete an environment with its contents."""
    partitions.drop(connection, connect)
    partitions.drop_schema(connection)
