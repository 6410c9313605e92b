"""URLs of environments on PostgreSQL: which server, which database, which environment in it.

``postgresql://user@host:port/database?environment=NAME`` and everything else that libpq takes in a
URL, its TLS parameters among them. An environment is a schema of its own, `hapticdb` unless named;
libpq's own way, ``?options=-csearch_path=NAME``, names it, too. ``?partitions=A,B`` names the
servers of the rows of an environment that is to be made (`hapticdb.store.postgres.partitions`).
"""

import re
from typing import NamedTuple
from urllib.parse import SplitResult, quote, unquote, urlsplit, urlunsplit

from hapticdb.errors import UsageError
from hapticdb.store.urls import PARTITIONS, redact

DEFAULT_ENVIRONMENT = "hapticdb"
SEARCH_PATH = re.compile(r"(?:-c\s*|--)search_path=(?:\"([^\"]+)\"|([^\s,]+))")
LONE_PERCENT = re.compile(r"%(?![0-9a-fA-F]{2})|%00")
LONGEST_NAME = 63


class Address(NamedTuple):
    """A URL taken apart.

    conninfo : for libpq, without hapticdb's own parameters; environment : the schema; shown : the
    whole URL as messages may show it; partitions : servers of the rows, for `partition_urls`.
    """

    conninfo: str
    environment: str
    shown: str
    partitions: tuple[str, ...] = ()


def parse(url: str) -> Address:
    """Take a URL apart.

    Raises `UsageError` when the environment's name cannot be a schema's, or is given twice; when
    the text is no URL; when the URL names a user or a database that no server can have.
    """
    parts = _split(url)
    _check_login(parts, url)
    named: list[str] = []
    partitions: list[str] = []
    others: list[str] = []
    found: str | None = None
    for pair in parts.query.split("&") if parts.query else []:
        key, _, value = pair.partition("=")
        if key == "environment":
            named.append(unquote(value))
        elif key == PARTITIONS:
            partitions += [unquote(one) for one in value.split(",")]
        else:
            # libpq takes no second = in a pair, and people write ?options=-cstatement_timeout=50
            others.append(f"{key}={value.replace('=', '%3D')}")
            if key == "options" and (match := SEARCH_PATH.search(unquote(value))):
                found = match[1] or match[2]
    if found is not None:
        named.append(found)
    if len(set(named)) > 1:
        raise UsageError(f"{redact(url)}: name one environment")
    environment = named[0] if named else DEFAULT_ENVIRONMENT
    _check_name(environment, url)
    conninfo = urlunsplit(parts._replace(query="&".join(others), fragment=""))
    if not parts.netloc:  # urlunsplit drops the empty host's slashes
        conninfo = f"{parts.scheme}://{parts.path}{'?' + '&'.join(others) if others else ''}"
    return Address(conninfo, environment, redact(url), tuple(partitions))


def _split(url: str) -> SplitResult:
    """Split a URL; refuse one that libpq would misread and then quote in its message.

    An @ that is not escaped in a password makes a part of the password a host, which libpq's
    message would show.
    """
    try:
        parts = urlsplit(url)
    except ValueError:  # the error's text may hold the password
        raise UsageError(f"{redact(url)} is no URL: check the host and its brackets") from None
    pairs = [pair.partition("=") for pair in parts.query.split("&") if pair]
    if (
        parts.netloc.count("@") > 1
        or "@" in parts.path
        or "#" in url
        or any(not equals or "@" in key for key, equals, _ in pairs)
        or LONE_PERCENT.search(url)
    ):
        raise UsageError(
            f"{redact(url)} is no URL: write @ : / ? # % in a password or name as "
            "%40 %3A %2F %3F %23 %25"
        )
    return parts


def with_environment(url: str, name: str) -> str:
    """Rewrite a URL so that it names another environment of the same database."""
    check_name(name, "an environment's name")
    head, _, query = url.partition("?")
    kept = [pair for pair in query.split("&") if pair and not pair.startswith("environment=")]
    for n, pair in enumerate(kept):
        if pair.startswith("options="):
            rest = SEARCH_PATH.sub("", unquote(pair.removeprefix("options="))).strip()
            kept[n] = f"options={quote(rest, safe='')}"
    named = f"environment={quote(name, safe='')}"
    return f"{head}?{'&'.join([*kept, named])}"


def partition_urls(address: Address) -> list[str]:
    """URLs of the partitions: each a URL, or a host whose user and database are the address's.

    Raises `UsageError` when one is neither.
    """
    own = _split(address.conninfo)
    login = own.netloc.rpartition("@")[0]
    found = []
    for given in address.partitions:
        url = given
        if "://" not in given:
            host = f"{login}@{given}" if login else given
            url = f"postgresql://{host}{own.path}{'?' + own.query if own.query else ''}"
        if not given or not url.startswith(("postgresql://", "postgres://")):
            raise UsageError(
                f"{address.shown}: a partition {redact(given)!r}: give hosts, or URLs of "
                "PostgreSQL, with commas between"
            )
        found.append(with_environment(url, address.environment))
    return found


def check_name(name: str, what: str) -> None:
    """Refuse a name that the server refuses, or that it would cut off at 63 bytes.

    Raises `UsageError` when it is no text, empty, or longer than 63 bytes in UTF-8.
    """
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


def _check_login(parts: SplitResult, url: str) -> None:
    """Refuse long names of users and databases: the server would cut them off to other names."""
    pairs = [pair.partition("=") for pair in parts.query.split("&")]
    user = parts.netloc.rpartition("@")[0].partition(":")[0]
    names = [("a user's name", user), ("a database's name", parts.path.removeprefix("/"))]
    names += [("a user's name", value) for key, _, value in pairs if unquote(key) == "user"]
    names += [("a database's name", value) for key, _, value in pairs if unquote(key) == "dbname"]
    for what, quoted in names:
        name = unquote(quoted)
        if len(name.encode("utf-8", "surrogateescape")) > LONGEST_NAME:
            raise UsageError(
                f"{redact(url)}: {what} {name!r} is longer than the {LONGEST_NAME} bytes that "
                "PostgreSQL allows: give it as the server lists it"
            )


def _check_name(name: str, url: str) -> None:
    if (
        not name
        or not name.isprintable()  # nor half a surrogate pair, which no server accepts
        or "$$" in name  # would end the text of a function
        or len(name.encode("utf-8", "surrogateescape")) > LONGEST_NAME
        or name.startswith("pg_")
        or name in {"public", "information_schema"}
    ):
        raise UsageError(
            f"{redact(url)}: {name!r} cannot be an environment's name; give one of 1 to "
            f"{LONGEST_NAME} bytes that is not the server's own"
        )
