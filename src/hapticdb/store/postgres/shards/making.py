"""Environments on several servers: made, found in the coordinator's catalogue, deleted."""

import contextlib
import secrets
import uuid
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote, urlsplit

from psycopg import errors, sql

from hapticdb.errors import (
    AccessError,
    DatabaseError,
    EnvironmentExistsError,
    EnvironmentNotFoundError,
    UsageError,
)
from hapticdb.grid import Grid
from hapticdb.store.base import Layout
from hapticdb.store.postgres import schema_of
from hapticdb.store.postgres.address import Address, parse
from hapticdb.store.postgres.connecting.connection import ServerConnection, identifier
from hapticdb.store.postgres.shards import schemas
from hapticdb.store.postgres.shards.connecting.links import ShardConnection, ShardPlace, Shards
from hapticdb.store.postgres.shards.connecting.places import private_shards, shard_conninfo
from hapticdb.store.postgres.shards.pieces import even_borders
from hapticdb.store.postgres.standby.aiming import aimed

IS_SHARDED = "SELECT to_regclass('distribution') IS NOT NULL"


def created(url: str, grid: Grid, layout: Layout, *, distances: bool) -> None:
    """Make the schemas of all shards, then the coordinator's, whose commit makes the environment.

    When it cannot be made, the schemas that were made for it are deleted again.
    """
    address = parse(url)
    token = str(uuid.UUID(bytes=secrets.token_bytes(16), version=4))
    made: list[ServerConnection] = []
    try:
        with schema_of.connected(url, making=True):
            for place in places_of(address, address.shards, making=True):
                made.append(_bare_connection(place, address))
                _make_shard(made[-1], layout, token)

        def also(coordinator: ServerConnection) -> None:
            _list_shards(coordinator, address.shards, grid, token)

        schema_of.created(url, grid, layout, distances=distances, also=also)
    except BaseException:
        if not _may_be_made(url, token):
            for shard in made:
                _drop_of(shard, token)
        raise
    finally:
        for shard in made:
            shard.close()


def _may_be_made(url: str, token: str) -> bool:
    """Whether the coordinator has an environment on these shards, or does not answer."""
    try:
        with schema_of.connected(url) as coordinator:
            if not is_sharded(coordinator):
                return False
            return coordinator.rows("SELECT token::text FROM distribution") == [(token,)]
    except EnvironmentNotFoundError:
        return False
    except DatabaseError:
        return True  # its commit may have been done although no answer came


def _bare_connection(place: ShardPlace, address: Address) -> ServerConnection:
    """Connection to a shard that may have no schema yet."""
    shown = f"shard {place.number} ({place.host}) of {address.shown}"
    of_shard = Address(place.conninfo, address.environment, None, shown)
    return ServerConnection(of_shard, aimed(place.conninfo, shown, read_only=False))


def _make_shard(shard: ServerConnection, layout: Layout, token: str) -> None:
    name = shard.address.environment

    def work() -> None:
        try:
            shard.execute(sql.SQL("CREATE SCHEMA {}").format(identifier(name)))
        except (errors.DuplicateSchema, errors.UniqueViolation) as error:
            raise EnvironmentExistsError(
                f"{shard.shown}: schema {name!r} exists already on this server; name another "
                "environment with ?environment=NAME, or drop the schema there if nobody needs it"
            ) from error
        except errors.InsufficientPrivilege as error:
            raise AccessError(
                f"{shard.shown}: this user may not make a schema there; the database's owner can "
                "allow it with 'GRANT CREATE ON DATABASE ... TO ...'"
            ) from error
        for statement in schemas.shard_statements(identifier(name), layout):
            shard.execute(statement)
        shard.execute("INSERT INTO mark VALUES (1, %s, 0, 0, 0)", (token,))

    shard.write(work, lambda: _has_token(shard, token))


def _list_shards(
    coordinator: ServerConnection, hosts: Sequence[str], grid: Grid, token: str
) -> None:
    for statement in schemas.COORDINATOR:
        coordinator.execute(statement)
    coordinator.execute("INSERT INTO distribution VALUES (1, %s, 0)", (token,))
    borders = even_borders(grid, len(hosts)).tolist()
    for number, (host, first) in enumerate(zip(hosts, borders, strict=True), 1):
        coordinator.execute("INSERT INTO shard VALUES (%s, %s, %s, 0)", (number, host, first))


def is_sharded(connection: ServerConnection) -> bool:
    """Whether the rows of an environment are on shards."""
    return connection.rows(IS_SHARDED) == [(True,)]


def shards_of(connection: ServerConnection) -> Shards:
    """The shards of an environment, as its catalogue lists them.

    Raises
    ------
    UsageError
        When the URL names other shards than the catalogue.
    """
    address = connection.address
    ((token,),) = connection.rows("SELECT token::text FROM distribution")
    hosts = [str(row[0]) for row in connection.rows("SELECT host FROM shard ORDER BY number")]
    if address.shards and list(address.shards) != hosts:
        raise UsageError(
            f"{address.shown}: the environment's shards are {','.join(hosts)}: leave shards= out"
        )
    return Shards(connection, places_of(address, hosts, making=False), str(token))


def places_of(address: Address, hosts: Sequence[str], *, making: bool) -> list[ShardPlace]:
    """Where the shards of an environment are; private servers are started."""
    coordinator = schema_of.conninfo(address, making=making)
    if address.data is not None:
        database = unquote(urlsplit(address.conninfo).path.strip("/")) or schema_of.DEFAULT_DATABASE
        urls = private_shards(Path(address.data), len(hosts), making=making, database=database)
    elif all(host.isdecimal() for host in hosts):
        raise DatabaseError(
            f"{address.shown}: its shards are private servers: open it with ?data=FOLDER"
        )
    else:
        urls = [shard_conninfo(address, coordinator, host) for host in hosts]
    return [ShardPlace(n, *pair) for n, pair in enumerate(zip(hosts, urls, strict=True), 1)]


def drop_shards(shards: Shards) -> None:
    """Delete the schemas of all shards, after the coordinator's."""

    def drop(_: int, shard: ShardConnection) -> None:
        _drop_of(shard, shards.token)

    shards.each(drop)


def _drop_of(shard: ServerConnection, token: str) -> None:
    """Delete a shard's schema if it is that environment's."""
    with contextlib.suppress(DatabaseError):  # its server is away
        if _has_token(shard, token):
            schema_of.drop(shard)


def _has_token(shard: ServerConnection, token: str) -> bool:
    """Whether a shard has been made for the environment of that token."""
    if shard.rows("SELECT to_regclass('mark') IS NULL") == [(True,)]:
        return False
    return shard.rows("SELECT token::text FROM mark") == [(token,)]
