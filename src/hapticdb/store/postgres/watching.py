"""How a reader learns that others have committed: by LISTEN, and by asking for the revision.

Each write notifies the environment's channel in its own transaction (PostgreSQL's manual: NOTIFY).
Looking whether a notification has arrived costs no round trip. Any role of the database may send
one: it is only a hint to ask for the revision, which only editors can raise.

The revision is also asked for now and then without a hint: for servers that refuse LISTEN, as a
standby does, for writers that do not notify, and for an environment that was dropped and made anew,
whose table has another oid.
"""

import hashlib
import time

import psycopg
from psycopg import sql

from hapticdb.store.postgres.address import LONGEST_NAME
from hapticdb.store.postgres.connecting import failures, wire
from hapticdb.store.postgres.connecting.connection import ServerConnection

REVISION = "SELECT revision, tableoid::bigint FROM environment WHERE id = 1"
DIGEST_DIGITS = 32
"""Hex digits of the digest that replaces too long a name. Fewer digits risk equal channels."""
HEARING_S = 1.0
"""Longest time until a commit without a notification is noticed, where LISTEN works."""
DEAF_S = 0.02
"""Longest time until a commit is noticed where LISTEN does not work."""
HINTED_S = 0.005
"""Shortest time between two hinted round trips: 200 a second under forged notifications."""


def channel_of(environment: str) -> str:
    """Name of an environment's channel, at most 63 bytes. A channel belongs to the database."""
    channel = f"hapticdb_{environment}"
    if len(channel.encode()) <= LONGEST_NAME:
        return channel
    # a dot instead of the underscore: never equal to the channel of a short name
    return f"hapticdb.{hashlib.sha256(environment.encode()).hexdigest()[:DIGEST_DIGITS]}"


class Watch:
    """Commits of others that one connection has noticed.

    revision : the newest noticed.
    """

    def __init__(self, connection: ServerConnection, identity: int) -> None:
        self._connection = connection
        self._identity = identity
        self._listening_on: psycopg.Connection[tuple[object, ...]] | None = None
        self.revision = self._told = -1
        self._is_hinted = False
        self._is_deaf = True
        self._due = self._asked = 0.0

    def begin(self, *, is_prompt: bool = False) -> None:
        """Notice commits from now on; see `Store.watch`."""
        self._connection.check_outside()
        self._connection.is_prompt = is_prompt
        self._connection.again(self._listen)
        self._ask()
        self._told = self.revision

    def has_changed(self) -> bool:
        """Whether something was committed since `begin` or the last call.

        Costs a round trip after a notification, after `HEARING_S` or `DEAF_S` without one, and
        after a lost connection; then true, because notifications may have been missed. Raises
        ConnectionLostError when the environment was remade.
        """
        self._connection.check_outside()
        self.look(HINTED_S)
        before, self._told = self._told, self.revision
        return before != self._told

    def look(self, pause: float = 0.0) -> bool:
        """Ask for `revision` if there may be another; whether it was asked for.

        pause : shortest time between two hinted round trips.
        """
        if self._connection.again(self._listen):
            self._told = -1
        else:
            now = time.monotonic()
            is_hinted = self._is_hinted and now >= self._asked + pause
            if not is_hinted and now < self._due:
                return False
        self._ask()
        return True

    def _listen(self) -> bool:
        """Receive notifications, or begin to listen on a new connection; whether it is new."""
        driver = self._connection.driver
        if driver is self._listening_on:
            self._connection.hear()
            return False
        driver.add_notify_handler(self._hear)
        channel = sql.Identifier(channel_of(self._connection.address.environment))
        try:
            self._connection.command(f"LISTEN {channel.as_string(driver)}")
            self._is_deaf = False
        except psycopg.Error as error:
            if failures.is_lost(error):
                raise
            self._is_deaf = True
        self._listening_on = driver
        self._due = 0.0  # if the query that follows fails, the next call asks again
        return True

    def _hear(self, _: psycopg.Notify) -> None:
        self._is_hinted = True

    def _ask(self) -> None:
        # cleared before the question, so that a commit after the answer sets it again
        self._is_hinted = False
        found, identity = self._connection.fetch(REVISION)
        if wire.read_int8(identity or b"") != self._identity:
            raise failures.remade(self._connection.shown)
        self.revision = wire.read_int8(found or b"")
        self._asked = time.monotonic()
        self._due = self._asked + (DEAF_S if self._is_deaf else HEARING_S)
