"""Notifications from roles without rights hide no edit and cause few extra questions."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import itertools
import os
from collections.abc import Iterator

import psycopg
import pytest
from psycopg import sql

from hapticdb.store.postgres import watching
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.store import PostgresStore
from hapticdb.store.postgres.watching import channel_of
from hapticdb.testing import is_noticed
from store.test_watch import asked, reader, url, write  # noqa: F401 - fixtures

numbers = itertools.count()
FORGED = [
    "",
    "nonsense",
    "-1",
    "0",
    "²",
    "9" * 5000,
    "9223372036854775807",
    "1e300",
    "\x1b[2J",
    "x" * 7999,
]


@pytest.fixture
def stranger(database: str, admin: psycopg.Connection) -> Iterator[psycopg.Connection]:
    """A connection of a role that has no right on any environment."""
    role = sql.Identifier(f"stranger {os.getpid()} {next(numbers)}")
    admin.execute(sql.SQL("CREATE ROLE {} LOGIN").format(role))
    with psycopg.connect(parse(database).conninfo, autocommit=True) as connection:
        connection.execute(sql.SQL("SET SESSION AUTHORIZATION {}").format(role))
        yield connection
    admin.execute(sql.SQL("DROP ROLE {}").format(role))


def test_words_of_strangers_on_the_channel_hide_no_edit(
    url: str,
    reader: PostgresStore,
    stranger: psycopg.Connection,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each edit is noticed by its own notification, as without forged ones."""
    monkeypatch.setattr(watching, "HEARING_S", 1e9)
    channel = channel_of(parse(url).environment)
    with pytest.raises(psycopg.errors.InsufficientPrivilege):
        stranger.execute(sql.SQL("SELECT * FROM {}.change").format(sql.Identifier(channel[9:])))
    seen: dict[bool, list[int]] = {False: [], True: []}
    reader.watch()
    for is_forged in (False, True):
        for payload in FORGED:
            if is_forged:
                stranger.execute(
                    "SELECT pg_notify(%s, %s || n) FROM generate_series(1, 200) AS n",
                    (channel, payload[:7990]),
                )
                stranger.execute("SELECT pg_notify(%s, %s)", (channel, payload))
                reader.has_changed()
            write(url)
            assert is_noticed(reader)
            seen[is_forged].append(reader.revision())
    n = len(FORGED)
    assert seen == {False: list(range(1, n + 1)), True: list(range(n + 1, 2 * n + 1))}


def test_a_flood_of_notifications_leads_to_few_round_trips(
    url: str,
    reader: PostgresStore,
    stranger: psycopg.Connection,
    asked: list[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Clock:
        now = 1e6

        def monotonic(self) -> float:
            return self.now

    clock = Clock()
    monkeypatch.setattr(watching, "time", clock)
    reader.watch()
    asked.clear()
    channel = channel_of(parse(url).environment)
    for n in range(100):  # the fetching process looks each millisecond
        clock.now += 1e-3
        stranger.execute(
            "SELECT pg_notify(%s, %s::text || n) FROM generate_series(1, 20) n", (channel, n)
        )
        reader.objects()  # a read also receives waiting notifications
        assert not reader.has_changed()
    assert 1 <= len(asked) <= 0.1 / watching.HINTED_S
    write(url)
    reader.objects()
    clock.now += watching.HINTED_S
    assert reader.has_changed()
