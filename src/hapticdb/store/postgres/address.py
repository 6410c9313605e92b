"""URLs of environments on PostgreSQL: server, database, environment.

``postgresql://user@host:port/database?environment=NAME``, with libpq's parameters, TLS among them.
An environment is a schema, `hapticdb` unless named. ``?partitions=A,B`` names the servers for the
rows of a new environment (`hapticdb.store.postgres.partitions`).
"""

from typing import NamedTuple
from urllib.parse import quote, unquote

from psycopg import ProgrammingError
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from hapticdb.errors import UsageError
from hapticdb.store.postgres.connecting import failures
from hapticdb.store.urls import PARTITIONS, redact

DEFAULT_ENVIRONMENT = "hapticdb"
LONGEST_NAME = 63


class Address(NamedTuple):
    """A parsed URL.

    conninfo : for libpq; environment : the schema; shown : the redacted URL; partitions : servers
    of the rows.
    """

    conninfo: str
    environment: str
    shown: str
    partitions: tuple[str, ...] = ()


def parse(url: str) -> Address:
    """Parse a URL; UsageError if libpq or the server cannot use it, or for two environments."""
    shown = redact(url)
    head, _, query = url.partition("?")
    authority, _, path = head.partition("://")[2].partition("/")
    # libpq would read part of a password with an @ as a host, and print it in its message
    if authority.count("@") > 1 or "@" in path or "#" in url or "\0" in url:
        raise failures.unusable("", shown)
    pairs = [pair.partition("=") for pair in query.split("&") if pair]
    named = {unquote(value) for key, _, value in pairs if key == "environment"}
    if len(named) > 1:
        raise UsageError(f"{shown}: name one environment")
    environment = named.pop() if named else DEFAULT_ENVIRONMENT
    _check_environment(environment, shown)
    spread = [value.split(",") for key, _, value in pairs if key == PARTITIONS]
    others = [
        # libpq accepts no second = in a pair; ?options=-cstatement_timeout=50 is common
        f"{key}{equals}{value.replace('=', '%3D')}"
        for key, equals, value in pairs
        if key not in {"environment", PARTITIONS}
    ]
    try:
        login = conninfo_to_dict(f"{head}?{'&'.join(others)}")
        for key, what in (("user", "user"), ("dbname", "database")):
            if name := str(login.get(key, "")):
                check_name(name, f"{shown}: a {what}'s name")
    except (ProgrammingError, UnicodeError) as error:  # not shown: it may hold the password
        raise failures.unusable(str(error), shown) from None
    hosts = tuple(unquote(one) for part in spread for one in part)
    return Address(make_conninfo("", **login), environment, shown, hosts)


def with_environment(url: str, name: str) -> str:
    """URL of another environment in the same database."""
    check_name(name, "an environment's name")
    head, _, query = url.partition("?")
    kept = [pair for pair in query.split("&") if pair and not pair.startswith("environment=")]
    named = f"environment={quote(name, safe='')}"
    return f"{head}?{'&'.join([*kept, named])}"


def partition_addresses(address: Address) -> list[Address]:
    """Addresses of the partitions: URLs, or hosts with the address's user and database."""
    own = conninfo_to_dict(address.conninfo, host=None, hostaddr=None, port=None)
    found = []
    for given in address.partitions:
        url = given if "://" in given else f"postgresql://{given}"
        if not given or not url.startswith(("postgresql://", "postgres://")):
            raise UsageError(
                f"{address.shown}: a partition {redact(given)!r}: give hosts, or URLs of "
                "PostgreSQL, with commas between"
            )
        part = parse(with_environment(url, address.environment))
        if url != given:
            part = part._replace(
                conninfo=make_conninfo("", **own | conninfo_to_dict(part.conninfo))
            )
        found.append(part)
    return found


def check_name(name: str, what: str) -> None:
    """Refuse a name other than a text of 1 to 63 bytes, the server's limit, without a byte 0."""
    if not isinstance(name, str):
        raise UsageError(f"{what} {name!r}: give a str, not {type(name).__name__}")
    try:
        n_bytes = len(name.encode())
    except UnicodeEncodeError:  # bytes that are not UTF-8, or half a surrogate pair
        raise UsageError(f"{what} {name!r} is no text: give it in UTF-8") from None
    if "\0" in name or not name:
        raise UsageError(f"{what} {name!r}: give one that is not empty, without a byte 0")
    if n_bytes > LONGEST_NAME:
        raise UsageError(
            f"{what} {name!r} has {n_bytes} bytes, and PostgreSQL's have {LONGEST_NAME} at most: "
            "give it as the server lists it"
        )


def _check_environment(name: str, shown: str) -> None:
    if (
        not name
        or not name.isprintable()  # nor half a surrogate pair
        or "$$" in name  # would end the text of a function
        or len(name.encode()) > LONGEST_NAME
        or name.startswith("pg_")
        or name in {"public", "information_schema"}
    ):
        raise UsageError(
            f"{shown}: {name!r} cannot be an environment's name; give one of 1 to "
            f"{LONGEST_NAME} bytes that is not the server's own"
        )
