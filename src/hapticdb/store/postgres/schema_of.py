"""The schema of an environment: made, opened, checked, brought up to date, dropped."""

import atexit
from typing import cast
from urllib.parse import unquote, urlsplit

from psycopg import errors, sql

from hapticdb.errors import (
    DatabaseError,
    EnvironmentExistsError,
    EnvironmentNotFoundError,
    NewerVersionError,
    NotAnEnvironmentError,
    ReadOnlyError,
)
from hapticdb.grid import CurveName, Grid
from hapticdb.store.base import LAYOUTS, Layout
from hapticdb.store.postgres import failures
from hapticdb.store.postgres.address import Address, parse
from hapticdb.store.postgres.session import Session, identifier
from hapticdb.store.private_server import PrivateServer
from hapticdb.store.schema import FORMAT_VERSION, MIGRATIONS

DEFAULT_DATABASE = "hapticdb"
_servers: dict[str, PrivateServer] = {}


def connected(url: str, *, read_only: bool = False) -> Session:
    """Connect to an environment's database, whether the environment is there or not."""
    address = parse(url)
    return Session(address, _conninfo(address), read_only=read_only)


def _conninfo(address: Address) -> str:
    """Where libpq is to go: with ``data=`` to a private server, started when it does not run."""
    if address.data is None:
        return address.conninfo
    parts = urlsplit(address.conninfo)
    if parts.netloc or parts.query:
        raise DatabaseError(
            f"{address.shown}: data= starts a server of its own: leave host and options out"
        )
    database = unquote(parts.path.strip("/")) or DEFAULT_DATABASE
    server = _servers.get(address.data)
    if server is None:
        server = PrivateServer.at(address.data)
        _servers[address.data] = server
        atexit.register(server.release)
    server.start()
    server.create_database(database)
    return server.conninfo(database)


def exists(url: str) -> bool:
    """Whether a schema of that name is there, an environment or not."""
    with connected(url, read_only=True) as session:
        return _has_schema(session)


def _has_schema(session: Session) -> bool:
    return bool(
        session.rows(
            "SELECT 1 FROM pg_namespace WHERE nspname = %s", (session.address.environment,)
        )
    )


def opened(url: str, *, read_only: bool) -> Session:
    """Connect to an existing environment; migrate it when it is older and may be written."""
    session = connected(url, read_only=read_only)
    try:
        _check(session)
    except BaseException:
        session.close()
        raise
    return session


def _check(session: Session) -> None:
    shown, name = session.shown, session.address.environment
    if not _has_schema(session):
        raise EnvironmentNotFoundError(
            f"no environment {name!r} at {shown}; make one with 'hapticdb import {shown} FILE'"
        )
    if not session.rows(
        "SELECT 1 FROM pg_class WHERE relnamespace = to_regnamespace(%s) AND relname = %s",
        (identifier(name).as_string(session.connection), "environment"),
    ):
        raise NotAnEnvironmentError(
            f"schema {name!r} at {shown} is no hapticdb environment; name another one with "
            "?environment=NAME"
        )
    try:
        found = session.rows("SELECT format FROM environment")
    except ReadOnlyError as error:  # reading, too, is a right
        raise failures.denied(shown, name) from error
    version = int(found[0][0]) if found else 0
    if not version >= 1:
        raise failures.damaged(shown, f"format {version}")
    if version > FORMAT_VERSION:
        raise NewerVersionError(
            f"{shown} has format {version}, newer than the {FORMAT_VERSION} known here: "
            "install a newer hapticdb"
        )
    if version < FORMAT_VERSION:
        if session.is_read_only:
            raise ReadOnlyError(
                f"{shown} has the older format {version}: open it once to write, "
                "and it is brought up to date"
            )
        session.write(lambda: _migrate(session, version))
    if not session.is_read_only:
        _check_writable(session)


def _check_writable(session: Session) -> None:
    """Tell at once, and not after a minute's work, that nothing may be written."""
    ((may_write, is_standby),) = session.rows(
        "SELECT has_table_privilege('cost', 'INSERT'), pg_is_in_recovery()"
    )
    if is_standby:
        raise ReadOnlyError(f"{session.shown} is a standby: it can only be read")
    if not may_write:
        raise ReadOnlyError(
            f"{session.shown} can only be read by this user; its owner can allow more with "
            "'hapticdb grant URL ROLE --as editor'"
        )


def read_environment(session: Session) -> tuple[Grid, Layout]:
    """Grid and layout of an environment."""
    rows = session.rows(
        "SELECT voxel_size, origin_x, origin_y, origin_z, bits, curve, layout FROM environment"
    )
    if len(rows) != 1 or rows[0][6] not in LAYOUTS:
        raise failures.damaged(session.shown, "no grid")
    size, x, y, z, bits, curve, layout = rows[0]
    return Grid(size, (x, y, z), bits, cast("CurveName", curve)), cast("Layout", layout)


def created(url: str, grid: Grid, layout: Layout) -> None:
    """Make the schema with all tables and the grid, in one transaction."""
    with connected(url) as session:
        name = session.address.environment

        def work() -> None:
            try:
                session.execute(sql.SQL("CREATE SCHEMA {}").format(identifier(name)))
            except (errors.DuplicateSchema, errors.UniqueViolation) as error:
                raise EnvironmentExistsError(
                    f"{session.shown}: schema {name!r} exists already; open it, or name another "
                    "environment with ?environment=NAME"
                ) from error
            _migrate(session, 0)
            session.execute(
                "INSERT INTO environment VALUES (1, %s, %s, %s, %s, %s, %s, %s, %s, 0)",
                (FORMAT_VERSION, grid.voxel_size, *grid.origin, grid.bits, grid.curve, layout),
            )

        session.write(work)


def _migrate(session: Session, version: int) -> None:
    """Run the migrations after `version`, inside a transaction."""
    schema = identifier(session.address.environment)
    for migration in MIGRATIONS[version:]:
        for statement in migration.postgres:
            session.execute(sql.SQL(statement).format(schema=schema))
    if version:
        session.execute("UPDATE environment SET format = %s", (FORMAT_VERSION,))


def drop(session: Session) -> None:
    """Delete an environment that nothing went into."""
    schema = identifier(session.address.environment)
    session.write(lambda: session.execute(sql.SQL("DROP SCHEMA {} CASCADE").format(schema)))
