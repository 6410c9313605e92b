"""The rows of all shards as tables at the coordinator, by postgres_fdw: for people who write SQL.

In the environment's schema at the coordinator stand, for each table of rows T (brick, band, voxel):

- `T_all`: a parent table, partitioned by ranges of `cell`; partition `T_N` is a foreign table over
  the view `T_of_shard` of shard N, which has the rows of the shard and the cell of each.
- `T_live`: a view of `T_all` that leaves out rows that no longer count, or do not count yet.
- `shard_mark`: the marks of all shards. `shard_check`: whether what a statement has read is whole.

A statement names the cells that it reads, ``cell = ANY (...)`` or ``cell BETWEEN ...``: the
planner then leaves out the other shards, and each shard looks its rows up in the index on (cell,
z_val, id, version). Without a condition on `cell` every shard sends all of its rows. Conditions of
joins are not sent: postgres_fdw considers that only with remote estimates, which cost a round trip
a plan.

A shard plans each statement anew. For ``z_val = ANY (...)`` it compares each element with each of
the most common values of `z_val`, of which there may be thousands: milliseconds for 240 keys, more
than the read itself (benchmarks/sharded_frames.py). ``cell`` has 100 of them at most. So statements
choose rows by cell, and the coordinator picks the keys.

Visibility is a look-up in the local table `live` for each row, not a join. A row counts under three
conditions: `live` names its version; it comes from the shard that owns its cell, because while a
border moves two shards have the row; and `shard_check` is true in the same statement. postgres_fdw
reads a shard in one snapshot a transaction, so the mark is as old as the rows. Under READ COMMITTED
a later statement of the same transaction sees the new `live` beside the old rows; `shard_check` is
then false. Put one statement into a transaction, or use REPEATABLE READ.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from psycopg import errors, sql
from psycopg.conninfo import conninfo_to_dict

from hapticdb.errors import AccessError, DatabaseError, UsageError
from hapticdb.store.base import CELL_SHIFT, Layout, Table, row_shift
from hapticdb.store.postgres.connecting.connection import ServerConnection, identifier
from hapticdb.store.postgres.tables.loading import TABLES

COLUMNS: dict[Table, tuple[tuple[str, str], ...]] = {
    "voxel": (),
    "brick": (("occupancy", "bytea"),),
    "band": (("distances", "bytea"),),
}
KEYS = (("z_val", "bigint"), ("id", "bigint"), ("version", "bigint"))
MARKS = (("token", "uuid"), ("writes", "bigint"), ("swept", "bigint"), ("moved", "bigint"))
SETTINGS_THERE = "-c enable_seqscan=off -c jit=off -c max_parallel_workers_per_gather=0"
"""Settings of the coordinator's sessions at shards; `connecting.link` says why for our own. Bitmap
scans stay on: only they read ranges that are joined by OR from an index."""
SERVER_OPTIONS = {
    "async_capable": "true",  # shards are asked at once, not one after the other
    "fetch_size": "100000",  # rows a round trip; the default of 100 takes several a frame
    "options": SETTINGS_THERE,
}
CUSTOM_PLANS = "SET plan_cache_mode = force_custom_plan"
"""For a session that prepares statements over `T_all`: partitions are left out only where the plan
knows the cells. `connecting.link` sets the opposite."""

# a cell's rows in the order of their keys; the index of z_val alone serves the owners' direct path
SHARD_VIEWS: dict[Table, tuple[str, ...]] = {
    table: (
        (
            f"CREATE INDEX IF NOT EXISTS {table}_cell"
            f" ON {table} ((z_val >> {CELL_SHIFT - row_shift(layout)}), z_val, id, version)"
        ),
        (
            f"CREATE OR REPLACE VIEW {table}_of_shard AS"
            f" SELECT {', '.join(name for name, _ in (*KEYS, *COLUMNS[table]))},"
            f" z_val >> {CELL_SHIFT - row_shift(layout)} AS cell FROM {table}"
        ),
    )
    for layout, tables in TABLES.items()
    for table in tables
}
"""What each shard needs for `align`, by table; run it there with the schema as search path."""

_HELD = "WITH held AS MATERIALIZED (SELECT * FROM {table}_live WHERE {chosen})"
_EXISTS = {
    "voxel": "EXISTS (SELECT 1 FROM held WHERE z_val = shell.key)",
    "brick": "EXISTS (SELECT 1 FROM held WHERE z_val = shell.key >> 9"
    " AND get_bit(occupancy, shell.key & 511) = 1)",
}
_CHOSEN = {
    "brick": "cell = ANY ({cells})",
    # a cell may have thousands of voxels, but it has 64 places for bricks
    "voxel": "cell = ANY ({cells}) AND z_val = ANY ($1)",
}
WRENCH: dict[Layout, str] = {
    layout: f"""
{_HELD.format(table=layout, chosen=_CHOSEN[layout].format(cells="$12"))}
SELECT force(ROW(($2)[n], ($3)[n], ($4)[n], ($5)[n], ($6)[n], ($7)[n],
                 $8, $9, $10, $11, shell.key)::hit ORDER BY n)
  FROM unnest($1) WITH ORDINALITY AS shell(key, n)
 WHERE {_EXISTS[layout]}"""
    for layout in TABLES
}
"""The paper's Figure 3 at the coordinator: `statements.WRENCH` with one parameter more, $12: the
cells (bigint[]) of the shell's points. Rows are fetched once, then looked up: the planner would
fetch whole tables for an EXISTS over foreign tables."""

READ_SHARDS = "SELECT number, first_key FROM shard ORDER BY number"
IS_AVAILABLE = "SELECT true FROM pg_available_extensions WHERE name = 'postgres_fdw'"
HAS_EXTENSION = "SELECT true FROM pg_extension WHERE extname = 'postgres_fdw'"
PARTS = """
SELECT relname::text FROM pg_class
 WHERE relnamespace = %s::regnamespace AND relkind = 'f'
   AND relname ~ '^(voxel|brick|band|mark)_[0-9]+$'"""
OUR_SERVERS = """
SELECT srvname::text, srvoptions, umoptions
  FROM pg_foreign_server LEFT JOIN pg_user_mappings USING (srvname)
 WHERE starts_with(srvname, %s)"""


class ForeignPlace(NamedTuple):
    """Where the coordinator's server finds a shard.

    server : libpq's words for host, port, dbname and the like, as the coordinator reaches the
    shard; user : ``user`` and, where the shard asks for one, ``password``. The password is then
    stored at the coordinator, where superusers and the owner of the environment can read it.
    """

    server: Mapping[str, str]
    user: Mapping[str, str]


class OwnedCells(NamedTuple):
    """A shard that owns cells: from `first` to before `last`; None: without a limit there."""

    number: int
    first: int
    last: int | None


def place_of(url: str) -> ForeignPlace:
    """Place of a shard by libpq's URL of it; empty parameters are left out."""
    words = {key: str(value) for key, value in conninfo_to_dict(url).items() if value}
    server = {key: value for key, value in words.items() if key != "user"}
    return ForeignPlace(server, {"user": words["user"]} if "user" in words else {})


def parts_of(shards: Sequence[tuple[int, int]]) -> list[OwnedCells]:
    """Shards that own cells, in the order of their cells.

    Parameters
    ----------
    shards : sequence of (number, first_key)
        Rows of the table `shard`, ascending by number. Keys are those of voxels.

    Raises
    ------
    UsageError
        When borders do not ascend from 0, or do not lie between cells.
    """
    firsts = [first >> CELL_SHIFT for _, first in shards]
    is_whole = all(first % (1 << CELL_SHIFT) == 0 for _, first in shards)
    if not firsts or firsts[0] != 0 or firsts != sorted(firsts) or not is_whole:
        raise UsageError(
            f"borders of shards {[first for _, first in shards]}: give multiples of "
            f"{1 << CELL_SHIFT} that ascend from 0"
        )
    lasts = [*firsts[1:], None]
    made = [OwnedCells(shards[n][0], firsts[n], lasts[n]) for n in range(len(shards))]
    return [part for part in made if part.first != part.last]


def align(connection: ServerConnection, layout: Layout, places: Mapping[int, ForeignPlace]) -> None:
    """Bring the foreign tables in line with the table `shard`; make them where there are none.

    Run it in the transaction that moves a border or adds a shard: then no statement sees the new
    borders before the commit, nor the old ones after it. It waits for statements that read the
    tables. Rights on the parents and views stay.

    Parameters
    ----------
    connection : ServerConnection
        To the coordinator, inside `write`, as the owner of the environment.
    layout : {"voxel", "brick"}
        Which tables of rows there are.
    places : mapping
        Place of each shard, by its number.

    Raises
    ------
    AccessError
        When the user may not make the extension or the servers.
    DatabaseError
        When the coordinator has no postgres_fdw.
    UsageError
        When a shard has no place, or borders do not lie between cells.
    """
    shards = [(int(n), int(key)) for n, key in connection.execute(READ_SHARDS).fetchall()]
    parts = parts_of(shards)
    missing = [n for n, _ in shards if n not in places]
    if missing:
        raise UsageError(f"{connection.shown}: no place for shard {missing[0]}: name its server")
    _make_extension(connection)
    for table in TABLES[layout]:
        _make_parent(connection, table)
    _drop_parts(connection)
    try:
        _make_servers(connection, {n: places[n] for n, _ in shards})
    except errors.InsufficientPrivilege as error:
        raise _refused(connection) from error
    for table in TABLES[layout]:
        for part in parts:
            _make_part(connection, table, part)
        _show(connection, table, parts)
    _make_marks(connection, [n for n, _ in shards])


def withdraw(connection: ServerConnection) -> None:
    """Drop the servers and all that stands on them; nothing if there are none.

    Servers belong to the database, so dropping the schema leaves them: call this before.
    """
    for name in _known_servers(connection):
        _run(connection, "DROP SERVER {name} CASCADE", name=name)


def _make_extension(connection: ServerConnection) -> None:
    if connection.execute(HAS_EXTENSION).fetchone():
        return
    if not connection.execute(IS_AVAILABLE).fetchone():
        raise DatabaseError(
            f"{connection.shown}: this server has no extension postgres_fdw: install PostgreSQL's "
            "package of extensions (contrib) there"
        )
    try:
        # in `public`: dropping the environment's schema must not drop other environments' servers
        connection.execute("CREATE EXTENSION IF NOT EXISTS postgres_fdw SCHEMA public")
    except errors.InsufficientPrivilege as error:
        raise _refused(connection) from error


def _refused(connection: ServerConnection) -> AccessError:
    user = connection.driver.info.user
    return AccessError(
        f"{connection.shown}: {user!r} may not make tables of other servers; a superuser of the "
        "coordinator can allow it with 'CREATE EXTENSION postgres_fdw' and "
        f"'GRANT USAGE ON FOREIGN DATA WRAPPER postgres_fdw TO {user}'"
    )


# -- servers -------------------------------------------------------------------------------------


def _prefix(connection: ServerConnection) -> str:
    """Begin of the names of this environment's servers: names of servers are the database's."""
    row = connection.execute("SELECT 'environment'::regclass::oid::bigint").fetchone()
    assert row is not None  # noqa: S101 - a SELECT without a table has a row
    return f"hapticdb_{row[0]}_"


def _server(connection: ServerConnection, number: int) -> str:
    return f"{_prefix(connection)}{number}"


def _known_servers(connection: ServerConnection) -> dict[str, tuple[set[str], set[str]]]:
    """Options of this environment's servers and of their users, by name."""
    rows = connection.execute(OUR_SERVERS, (_prefix(connection),)).fetchall()
    return {name: (set(there or ()), set(user or ())) for name, there, user in rows}


def _make_servers(connection: ServerConnection, places: Mapping[int, ForeignPlace]) -> None:
    """Make servers; those that are as wanted stay, and with them the open sessions there."""
    known = _known_servers(connection)
    for number, place in places.items():
        name = _server(connection, number)
        there = {**SERVER_OPTIONS, **place.server}
        user = dict(place.user)
        if "password" not in user and _is_superuser(connection):
            user["password_required"] = "false"  # noqa: S105 - no password
        before = known.pop(name, None)
        if before == (_pairs(there), _pairs(user)):
            continue
        if before is not None:
            _run(connection, "DROP SERVER {name} CASCADE", name=name)
        _run(
            connection,
            "CREATE SERVER {name} FOREIGN DATA WRAPPER postgres_fdw OPTIONS ({options})",
            name=name,
            options=_options(there),
        )
        # of the owner only: a view's foreign tables are read as the view's owner
        _run(
            connection,
            "CREATE USER MAPPING FOR CURRENT_USER SERVER {name} OPTIONS ({options})",
            name=name,
            options=_options(user),
        )
    for name in known:
        _run(connection, "DROP SERVER {name} CASCADE", name=name)


def _is_superuser(connection: ServerConnection) -> bool:
    row = connection.execute("SELECT current_setting('is_superuser') = 'on'").fetchone()
    return row is not None and bool(row[0])


def _pairs(options: Mapping[str, str]) -> set[str]:
    return {f"{name}={value}" for name, value in options.items()}


def _options(options: Mapping[str, str]) -> sql.Composed:
    return sql.SQL(", ").join(
        sql.SQL("{} {}").format(identifier(name), sql.Literal(value))
        for name, value in options.items()
    )


# -- tables --------------------------------------------------------------------------------------


def _make_parent(connection: ServerConnection, table: Table) -> None:
    """Make the parent if there is none; its view shows nothing until `_show`."""
    named = (*KEYS, *COLUMNS[table], ("cell", "bigint"))
    columns = ", ".join(f"{name} {kind} NOT NULL" for name, kind in named)
    connection.execute(
        f"CREATE TABLE IF NOT EXISTS {table}_all ({columns}) PARTITION BY RANGE (cell)"
    )
    connection.execute(_view(table, "false"))


def _view(table: Table, condition: str) -> str:
    shown = ", ".join(["z_val", "id", *(name for name, _ in COLUMNS[table]), "cell"])
    return (
        f"CREATE OR REPLACE VIEW {table}_live AS"
        f" SELECT {shown} FROM {table}_all AS held WHERE {condition}"
    )


def _drop_parts(connection: ServerConnection) -> None:
    schema = connection.address.environment
    found = connection.execute(PARTS, (sql.Identifier(schema).as_string(),)).fetchall()
    if any(name.startswith("mark_") for (name,) in found):
        connection.execute(_marks(()))
    for (name,) in found:
        _run(connection, "DROP FOREIGN TABLE {name}", name=name)


def _make_part(connection: ServerConnection, table: Table, part: OwnedCells) -> None:
    last = "MAXVALUE" if part.last is None else str(part.last)
    _run(
        connection,
        f"CREATE FOREIGN TABLE {{name}} PARTITION OF {table}_all"
        f" FOR VALUES FROM ({part.first}) TO ({last}) SERVER {{server}} OPTIONS ({{options}})",
        name=f"{table}_{part.number}",
        server=_server(connection, part.number),
        options=_there(connection, f"{table}_of_shard"),
    )


def _there(connection: ServerConnection, table: str) -> sql.Composed:
    """Options of a foreign table: its name at the shard."""
    return _options({"schema_name": connection.address.environment, "table_name": table})


def _show(connection: ServerConnection, table: Table, parts: Sequence[OwnedCells]) -> None:
    """Make the view show the rows that count.

    While a border moves, two shards have the rows of some cells, and a foreign table sends all that
    its shard has, also outside of its partition's bounds. So a row must come from its owner.
    """
    owners = ", ".join(f"'{table}_{part.number}'::regclass" for part in parts)
    firsts = ", ".join(str(part.first) for part in parts)
    connection.execute(
        _view(
            table,
            f"(SELECT live.version FROM live WHERE live.id = held.id) = held.version"
            f" AND held.tableoid ="
            f" (ARRAY[{owners}]::oid[])[width_bucket(held.cell, ARRAY[{firsts}]::bigint[])]",
        )
    )


# -- marks ---------------------------------------------------------------------------------------

CHECK = """
CREATE OR REPLACE VIEW shard_check AS
SELECT count(*) = (SELECT count(*) FROM shard)
       AND bool_and(token = (SELECT token FROM distribution)
                    AND writes >= (SELECT writes FROM shard WHERE shard.number = shard_mark.number)
                    AND swept <= (SELECT revision FROM environment)
                    AND moved <= (SELECT epoch FROM distribution)) AS is_whole
  FROM shard_mark"""


def _make_marks(connection: ServerConnection, numbers: Sequence[int]) -> None:
    columns = ", ".join(f"{name} {kind}" for name, kind in MARKS)
    for number in numbers:
        _run(
            connection,
            f"CREATE FOREIGN TABLE {{name}} ({columns}) SERVER {{server}} OPTIONS ({{options}})",
            name=f"mark_{number}",
            server=_server(connection, number),
            options=_there(connection, "mark"),
        )
    connection.execute(_marks(numbers))
    connection.execute(CHECK)


def _marks(numbers: Sequence[int]) -> str:
    """The view of all marks; of no marks where there are no numbers."""
    nothing = ", ".join(f"NULL::{kind} AS {name}" for name, kind in MARKS)
    names = ", ".join(name for name, _ in MARKS)
    each = [f"SELECT {number} AS number, {names} FROM mark_{number}" for number in numbers]
    body = " UNION ALL ".join(each) or f"SELECT 0 AS number, {nothing} WHERE false"
    return f"CREATE OR REPLACE VIEW shard_mark AS {body}"


def _run(
    connection: ServerConnection, text: str, *, options: sql.Composed | None = None, **names: str
) -> None:
    """Run a statement with names and options put in, quoted."""
    words: dict[str, sql.Composable] = {word: identifier(name) for word, name in names.items()}
    if options is not None:
        words["options"] = options
    connection.execute(sql.SQL(text).format(**words))
