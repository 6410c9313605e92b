"""Names of roles, users, databases and environments that the server would read as others."""

import os
from collections.abc import Iterator
from urllib.parse import quote

import psycopg
import pytest

from hapticdb import Grid
from hapticdb.errors import UsageError
from hapticdb.store.connect import create_store, grant
from hapticdb.store.postgres.address import LONGEST_NAME, parse, with_environment
from servers import Place, roles

GRID = Grid(0.005, (0, 0, 0), 7)
LONG = "r" * 64


def of_bytes(start: str, letter: str) -> str:
    """A name of at most LONGEST_NAME bytes, as long as whole letters allow."""
    return start + letter * ((LONGEST_NAME - len(start.encode())) // len(letter.encode()))


@pytest.fixture(params=["r", "é", "語"])
def role(request: pytest.FixtureRequest, admin: psycopg.Connection) -> Iterator[str]:
    """A role with a name of the greatest length."""
    name = of_bytes(f"{os.getpid()}", request.param)
    with roles(admin, name):
        yield name


def may_read(admin: psycopg.Connection, role: str, url: str) -> bool:
    row = admin.execute(
        "SELECT has_schema_privilege(%s, %s, 'USAGE')", (role, parse(url).environment)
    ).fetchone()
    assert row is not None
    return bool(row[0])


def test_grant_role_name_too_long(place: Place, role: str, admin: psycopg.Connection) -> None:
    url = place()
    create_store(url, GRID).close()
    for longer in (role + "語", role + "r" * 10_000):
        n_bytes = len(longer.encode())
        with pytest.raises(
            UsageError, match=rf"^a role's name .* has {n_bytes} bytes.* 63 at most"
        ):
            grant(url, longer, "viewer")
    assert not may_read(admin, role, url)
    grant(url, role, "viewer")
    assert may_read(admin, role, url)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("\udcff", r"'\\udcff' is no text: give it in UTF-8"),
        ("\ud800", "is no text"),
        ("a\0b", "without a byte 0"),
        ("", "not empty"),
        (b"anna", "give a str, not bytes"),
        (None, "give a str, not NoneType"),
    ],
)
def test_grant_role_name_bad_characters(place: Place, name: str, told: str) -> None:
    url = place()
    create_store(url, GRID).close()
    with pytest.raises(UsageError, match=rf"^a role's name [^\n]*{told}[^\n]*$"):
        grant(url, name, "viewer")


@pytest.mark.parametrize(
    "url",
    [
        f"postgresql://{LONG}@localhost/db",
        f"postgresql://{LONG}:secret@localhost/db",
        f"postgresql://localhost/{LONG}",
        f"postgresql://localhost/{'%C3%A9' * 32}",
        f"postgresql:///?user={LONG}",
        f"postgresql:///?dbname={LONG}",
        f"postgresql:///?%75ser={LONG}",
    ],
)
def test_parse_url_name_too_long(url: str) -> None:
    with pytest.raises(
        UsageError, match=r"'s name '\S+' has 6\d bytes, and PostgreSQL's have 63 at most"
    ) as error:
        parse(url)
    assert "secret" not in str(error.value)
    assert parse(url.replace(LONG, LONG[:63]).replace("%C3%A9" * 32, "%C3%A9" * 31))


@pytest.mark.parametrize("letter", ["r", "é", "語"])
def test_environment_name_length_in_bytes(letter: str) -> None:
    name = of_bytes("", letter)
    assert parse(with_environment("postgresql:///db", name)).environment == name
    for wrong in (name + letter, "\udcff", "\ud800", "a\0b"):
        with pytest.raises(UsageError, match=r"^an environment's name [^\n]+$"):
            with_environment("postgresql:///db", wrong)
    with pytest.raises(UsageError, match=r"cannot be an environment's name; give one of 1 to 63"):
        parse(f"postgresql:///db?environment={quote(name + letter)}")
