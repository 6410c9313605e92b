"""The PostgreSQL servers that tests run against: one of each version for the whole run."""

import contextlib
import fcntl
import itertools
import os
import signal
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from urllib.parse import quote, urlencode

import psycopg
import pytest
from psycopg import conninfo, sql

import children
from hapticdb.resident.table import is_alive
from hapticdb.store.postgres.address import parse, with_environment
from postgres_servers import PORT, Binaries, Server, find_binaries

SETTINGS = {"fsync": "off", "full_page_writes": "off", "max_connections": "200"}
"""Settings of the servers. A crash of the machine may lose data; a kill of processes does not."""
_numbers = itertools.count()


def _found() -> list[Binaries]:
    found = find_binaries()
    wanted = os.environ.get("HAPTICDB_TEST_POSTGRES_MAJORS", "")
    missing = {int(word) for word in wanted.split(",") if word} - {b.major for b in found}
    if missing or not found:
        which = ", ".join(map(str, sorted(missing))) or "at all"
        pytest.exit(f"no PostgreSQL {which}: 'make test' installs 18", 1)
    return found


FOUND = _found()
ENGINES: list[Binaries | None] = [None, *FOUND]
"""SQLite, and every server: `url_on` gives an environment's URL there."""


def named(found: Binaries | None) -> str:
    """Name of an engine, as tests show it."""
    return f"postgres{found.major}" if found else "sqlite"


@cache
def shared_server(found: Binaries) -> Server:
    """The running server of that version, which all processes of this run use."""
    folder = children.shared_folder() / str(found.major)
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        server = Server(folder, found, SETTINGS)
        if not (server.data / "postmaster.pid").exists():
            server.start()
    return server


@cache
def base_url(found: Binaries) -> str:
    """URL of this process's database on that server."""
    server, name = shared_server(found), f"tests_{os.getpid()}"
    with psycopg.connect(server.conninfo(), autocommit=True) as connection:
        connection.execute(sql.SQL("CREATE DATABASE {}").format(sql.Identifier(name)))
    return server.conninfo(name)


def kill(server: Server) -> None:
    """End a running server and its children as a crash does, so that it can be started again."""
    os.kill(server.pid, signal.SIGSTOP)  # so that it starts no more children
    family = [*children.descendants(server.pid), server.pid]
    for member in family:
        with contextlib.suppress(ProcessLookupError):
            os.kill(member, signal.SIGKILL)
    children.until(lambda: not any(map(is_alive, family)))
    # a zombie that nobody waits for would seem to PostgreSQL to hold them
    (server.data / "postmaster.pid").unlink()
    (server.folder / f".s.PGSQL.{PORT}.lock").unlink()


Place = Callable[[], str]
"""Gives the URL of an environment that does not exist yet; it is dropped after the test."""


@pytest.fixture(scope="session", params=FOUND, ids=named)
def database(request: pytest.FixtureRequest) -> str:
    """URL of a database, once for each server found."""
    return base_url(request.param)


@contextlib.contextmanager
def places(database: str) -> Iterator[Place]:
    given: list[str] = []

    def new() -> str:
        given.append(f"test_{os.getpid()}_{next(_numbers)}")
        return with_environment(database, given[-1])

    try:
        yield new
    finally:
        with psycopg.connect(parse(database).conninfo, autocommit=True) as connection:
            for name in given:
                drop = sql.SQL("DROP SCHEMA IF EXISTS {} CASCADE").format(sql.Identifier(name))
                connection.execute("SET client_min_messages = warning")
                connection.execute(drop)


@pytest.fixture
def place(database: str) -> Iterator[Place]:
    with places(database) as new:
        yield new


@contextlib.contextmanager
def url_on(engine: Binaries | None, folder: Path) -> Iterator[str]:
    """URL of an environment that does not exist yet; a server drops it at the end."""
    if engine is None:
        yield str(folder / "e.db")
        return
    with places(base_url(engine)) as new:
        yield new()


@pytest.fixture
def admin(database: str) -> Iterator[psycopg.Connection]:
    """A plain connection as the owner, to ask the server itself."""
    with psycopg.connect(parse(database).conninfo, autocommit=True) as connection:
        yield connection


PASSWORD = "of-a-test"  # noqa: S105 - of roles that live as long as a test


@contextlib.contextmanager
def roles(admin: psycopg.Connection, *names: str, password: str = PASSWORD) -> Iterator[None]:
    """Roles of the server that may log in."""
    quoted = [sql.Identifier(name) for name in names]
    for name in quoted:
        admin.execute(sql.SQL("CREATE ROLE {} LOGIN PASSWORD {}").format(name, password))
    try:
        yield
    finally:
        for name in quoted:
            admin.execute(sql.SQL("DROP OWNED BY {}").format(name))
            admin.execute(sql.SQL("DROP ROLE {}").format(name))


def url_as(url: str, role: str, password: str = PASSWORD) -> str:
    """URL of the same environment for another user."""
    address = parse(url)
    known = conninfo.conninfo_to_dict(address.conninfo)
    wanted = {**known, "user": role, "password": password, "environment": address.environment}
    return f"postgresql:///?{urlencode(wanted, quote_via=quote)}"
