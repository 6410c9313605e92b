"""What is said of servers that cannot be reached: one short line, each host once."""

import psycopg
import pytest

from hapticdb.errors import ConnectionLostError, HapticDBError, ReadOnlyError
from hapticdb.store.postgres.connecting import failures

ADVICE = "\n\tIs the server running on that host and accepting TCP/IP connections?"
MANY = "\nMultiple connection attempts failed. All failures were:\n"


def attempt(host: str, port: int, reason: str, address: str = "127.0.0.1") -> str:
    """What psycopg says of one attempt among several."""
    where = f'connection to server at "{address}", port {port} failed: '
    place = f"- host: '{host}', port: '{port}', hostaddr: '{address}'"
    return f"{place}: connection failed: {where}{reason}"


def told(*attempts: str) -> HapticDBError:
    last = attempts[-1].partition("': connection failed: ")[2]
    text = f"connection failed: {last}{MANY}" + "\n".join(attempts)
    return failures.refused(psycopg.OperationalError(text), "postgresql://many/x")


def test_refused_names_each_host_once() -> None:
    error = told(
        attempt("one", 5432, f"Connection refused{ADVICE}", "::1"),
        attempt("one", 5432, f"Connection refused{ADVICE}"),
        attempt("two", 5433, f"No route to host{ADVICE}"),
        "- host: 'three', port: '5432', hostaddr: '10.0.0.1': connection timeout expired",
    )
    assert isinstance(error, ConnectionLostError)
    assert str(error) == (
        "postgresql://many/x cannot be reached: one:5432: Connection refused; "
        "two:5433: No route to host; three:5432: connection timeout expired"
    )


def test_refused_omits_standby_hosts() -> None:
    standby = attempt("standby", 5432, "server is in hot standby mode")
    error = told(standby, attempt("primary", 5432, f"Connection refused{ADVICE}"))
    assert isinstance(error, ConnectionLostError)
    assert "standby:5432" not in str(error)
    assert "the primary cannot be reached: primary:5432: Connection refused; " in str(error)
    assert isinstance(told(standby, standby), ReadOnlyError)


@pytest.mark.parametrize(
    "reason",
    [
        "sorry, too many clients already",
        'too many connections for role "anna"',
        "remaining connection slots are reserved for roles with the SUPERUSER attribute",
        "no more connections allowed (max_client_conn)",
    ],
)
def test_refused_server_without_free_connection(reason: str) -> None:
    where = 'connection failed: connection to server on socket "/run/.s.PGSQL.5432" failed: '
    text = f"{where}FATAL:  {reason}"
    error = failures.refused(psycopg.OperationalError(text), "URL")
    assert isinstance(error, ConnectionLostError)
    assert str(error) == (
        f"URL has no free connection (/run/.s.PGSQL.5432: {reason}): end "
        "programs that use this server, or raise max_connections there"
    )
