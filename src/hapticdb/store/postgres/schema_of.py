"""The schema of an environment: made, opened, checked, brought up to date, dropped."""

import atexit
import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

from psycopg import errors, sql

from hapticdb.errors import (
    AccessError,
    EnvironmentExistsError,
    EnvironmentNotFoundError,
    NewerVersionError,
    NotAnEnvironmentError,
    ReadOnlyError,
    UsageError,
)
from hapticdb.grid import Grid
from hapticdb.store import believed
from hapticdb.store.base import Layout
from hapticdb.store.postgres import failures
from hapticdb.store.postgres.address import Address, parse
from hapticdb.store.postgres.migrations import MIGRATIONS
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.store.postgres.session import Session, identifier
from hapticdb.store.schema import FORMAT_VERSION, migrations_after

DEFAULT_DATABASE = "hapticdb"
SERVER_IS_OURS = re.compile(r"(?:^|&)(?:host|hostaddr|port|user|service)=")
_servers: dict[Path, PrivateServer] = {}


def connected(url: str, *, read_only: bool = False, making: bool = False) -> Session:
    """Connect to an environment's database, whether the environment is there or not.

    `making` one sets up a private server and its database where they are missing.
    """
    address = parse(url)
    try:
        return Session(address, _conninfo(address, making=making), read_only=read_only)
    except EnvironmentNotFoundError as error:
        raise error if address.data is None else _not_found(address) from None


def _conninfo(address: Address, *, making: bool) -> str:
    """Where libpq is to go: with ``data=`` to a private server, started when it does not run."""
    if address.data is None:
        return address.conninfo
    parts = urlsplit(address.conninfo)
    if parts.netloc or SERVER_IS_OURS.search(parts.query):
        raise UsageError(
            f"{address.shown}: data= starts a server of its own: leave host, port and user out"
        )
    folder = Path(address.data).expanduser().absolute()
    if not making and not folder.exists():
        raise _not_found(address)
    server = _servers.get(folder)
    if server is None:
        server = PrivateServer.at(folder)
        _servers[folder] = server
        atexit.register(server.release)
    server.start()
    database = unquote(parts.path.strip("/")) or DEFAULT_DATABASE
    if making:
        server.create_database(database)
    return "&".join(filter(None, (server.conninfo(database), parts.query)))


def _not_found(address: Address) -> EnvironmentNotFoundError:
    return EnvironmentNotFoundError(
        f"no environment {address.environment!r} at {address.shown}; make one with "
        "'hapticdb import URL FILE'"
    )


def exists(url: str) -> bool:
    """Whether a schema of that name is there, an environment or not."""
    try:
        with connected(url, read_only=True) as session:
            return _has_schema(session)
    except EnvironmentNotFoundError:
        if parse(url).data is None:
            raise
        return False


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
        check(session)
        if not read_only:
            _check_writable(session)
    except BaseException:
        session.close()
        raise
    return session


def check(session: Session) -> None:
    """Refuse what is no environment of ours or may not be read; migrate an older one."""
    shown, name = session.shown, session.address.environment
    if not _has_schema(session):
        raise _not_found(session.address)
    readable = session.rows(
        "SELECT has_schema_privilege(n.oid, 'USAGE') AND has_table_privilege(c.oid, 'SELECT')"
        "  FROM pg_class c JOIN pg_namespace n ON n.oid = c.relnamespace"
        " WHERE n.nspname = %s AND c.relname = 'environment'",
        (name,),
    )
    if not readable:
        raise NotAnEnvironmentError(
            f"schema {name!r} at {shown} is no hapticdb environment; name another one with "
            "?environment=NAME"
        )
    if readable != [(True,)]:  # without the right, the schema is passed over in silence
        raise failures.denied(shown, name)
    found = session.rows("SELECT format FROM environment")
    version = int(found[0][0]) if found else 0
    if not version >= 1:
        raise believed.damaged(shown, f"format {version}")
    if version > FORMAT_VERSION:
        raise NewerVersionError(
            f"{shown} has format {version}, newer than the {FORMAT_VERSION} known here: "
            "install a newer hapticdb"
        )
    missing = [step for step in migrations_after(version, MIGRATIONS) if step.statements]
    if missing and not session.is_read_only and session.is_owner():
        session.write(lambda: _migrate_once(session))
    elif any(step.readers_need_it for step in missing):
        raise ReadOnlyError(
            f"{shown} has the older format {version}: its owner has to open it once to "
            "write, and it is brought up to date"
        )


def _check_writable(session: Session) -> None:
    """Tell at once, and not after a minute's work, that nothing may be written.

    A toucher writes cost figures, no more; `Loading` tells at once that objects are not for it.
    """
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


TABLE_KINDS = """
SELECT relname::text, CASE relkind WHEN 'r' THEN 'table' WHEN 'v' THEN 'view'
                      WHEN 'm' THEN 'materialized view' ELSE 'relation ' || relkind::text END
  FROM pg_class JOIN pg_namespace n ON n.oid = relnamespace
 WHERE nspname = %s AND relkind <> 'i'"""


def read_environment(session: Session) -> tuple[Grid, Layout, int]:
    """Grid and layout of an environment, and what tells it from another in its place."""
    rows = session.rows(
        "SELECT voxel_size, origin_x, origin_y, origin_z, bits, curve, layout, tableoid::bigint"
        " FROM environment"
    )
    grid, layout = believed.grid_of(session.shown, rows)
    kinds = session.rows(TABLE_KINDS, (session.address.environment,))
    believed.check_tables(session.shown, dict(kinds))
    return grid, layout, rows[0][7]


def created(url: str, grid: Grid, layout: Layout) -> None:
    """Make the schema with all tables and the grid, in one transaction."""
    with connected(url, making=True) as session:
        name = session.address.environment

        def work() -> None:
            try:
                session.execute(sql.SQL("CREATE SCHEMA {}").format(identifier(name)))
            except (errors.DuplicateSchema, errors.UniqueViolation) as error:
                raise EnvironmentExistsError(
                    f"{session.shown}: schema {name!r} exists already; open it, or name another "
                    "environment with ?environment=NAME"
                ) from error
            except errors.InsufficientPrivilege as error:
                raise AccessError(
                    f"{session.shown}: there is no environment {name!r}, and this user may not "
                    "make one; the database's owner can allow it with "
                    "'GRANT CREATE ON DATABASE ... TO ...'"
                ) from error
            _migrate(session, 0)
            session.execute(
                "INSERT INTO environment VALUES (1, %s, %s, %s, %s, %s, %s, %s, %s, 0)",
                (FORMAT_VERSION, grid.voxel_size, *grid.origin, grid.bits, grid.curve, layout),
            )

        session.write(work, lambda: _has_schema(session))


def _migrate_once(session: Session) -> None:
    """Migrate from the version that is there once nobody else migrates."""
    row = session.execute("SELECT format FROM environment FOR UPDATE").fetchone()
    assert row is not None  # noqa: S101 - it was there before
    _migrate(session, int(row[0]))


def _migrate(session: Session, version: int) -> None:
    """Run the migrations after `version`, inside a transaction."""
    schema = identifier(session.address.environment)
    for migration in migrations_after(version, MIGRATIONS):
        for statement in migration.statements:
            session.execute(sql.SQL(statement).format(schema=schema))
    if version:
        session.execute("UPDATE environment SET format = %s", (FORMAT_VERSION,))


def drop(session: Session) -> None:
    """Delete an environment, whatever is in it."""
    schema = identifier(session.address.environment)
    session.write(
        lambda: session.execute(sql.SQL("DROP SCHEMA {} CASCADE").format(schema)),
        lambda: not _has_schema(session),
    )
