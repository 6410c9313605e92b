"""Detection of other clients' commits, by LISTEN and by polling of the revision.

Each write notifies the environment's channel in its own transaction (PostgreSQL's manual: NOTIFY).
Checking for a received notification costs no round trip. Any role of the database may send one: it
is only a hint to poll the revision, and only editors can raise that.

The revision is also polled without a hint, every `LISTENING_S` or `POLLING_S`: for servers without
LISTEN, such as standbys, for writers without NOTIFY, and for an environment dropped and created
anew, with another oid of its table.
"""

import hashlib
import time

import psycopg
from psycopg import sql

from hapticdb.store.postgres.address import LONGEST_NAME
from hapticdb.store.postgres.connecting import failures, wire
from hapticdb.store.postgres.connecting.server_connection import ServerConnection

REVISION = "SELECT revision, tableoid::bigint FROM environment WHERE id = 1"
LISTENING_S = 1.0
"""Longest delay of a commit without a notification, where LISTEN works, s."""
POLLING_S = 0.02
"""Longest delay of a commit where LISTEN does not work, s."""
HINTED_S = 0.005
"""Shortest time between two hinted round trips, s: 200 a second under forged notifications."""


def channel_of(environment: str) -> str:
    """Name of an environment's channel in its database, at most 63 bytes."""
    channel = f"hapticdb_{environment}"
    if len(channel.encode()) <= LONGEST_NAME:
        return channel
    # a dot instead of the underscore: never equal to the channel of a short name
    return f"hapticdb.{hashlib.sha256(environment.encode()).hexdigest()[:32]}"


class Watch:
    """Newest revision seen by one connection, with its notifications.

    revision : the newest one.
    """

    def __init__(self, connection: ServerConnection, identity: int) -> None:
        self._connection = connection
        self._identity = identity
        self._listening_on: psycopg.Connection[tuple[object, ...]] | None = None
        self.revision = self._reported = -1
        self._is_hinted = False
        self._is_polling = True
        self._due = self._asked = 0.0

    def begin(self, *, is_prompt: bool = False) -> None:
        """Begin to notice commits; see `Store.watch`."""
        self._connection.check_outside()
        self._connection.is_prompt = is_prompt
        # LISTEN before the first query: a commit between the two sends a notification
        self._connection.again(self._listen)
        self._query_revision()
        self._reported = self.revision

    def has_changed(self) -> bool:
        """Whether something was committed since `begin` or the last call.

        Costs a round trip after a notification, after `LISTENING_S` or `POLLING_S` without one, and
        after a lost connection; then true, because notifications may have been missed. Raises
        ConnectionLostError when the environment was recreated.
        """
        self._connection.check_outside()
        self.poll(HINTED_S)
        # against the last report: a poll of `newest` may have seen the commit before this call
        before, self._reported = self._reported, self.revision
        return before != self._reported

    def poll(self, pause: float = 0.0) -> bool:
        """Poll `revision` if it may have changed; returns whether it was polled.

        pause : shortest time between two hinted round trips, s.
        """
        # a new connection: notifications sent before its LISTEN never arrive
        if self._connection.again(self._listen):
            self._reported = -1
        else:
            now = time.monotonic()
            is_hinted = self._is_hinted and now >= self._asked + pause
            if not is_hinted and now < self._due:
                return False
        self._query_revision()
        return True

    def _listen(self) -> bool:
        """Receive notifications, or LISTEN on a new connection; returns whether it is new."""
        driver = self._connection.driver
        # by identity: a reconnect makes another driver, on which nothing listens yet
        if driver is self._listening_on:
            self._connection.receive_notifications()
            return False
        driver.add_notify_handler(self._on_notification)
        channel = sql.Identifier(channel_of(self._connection.address.environment))
        try:
            self._connection.command(f"LISTEN {channel.as_string(driver)}")
            self._is_polling = False
        except psycopg.Error as error:
            if failures.is_lost(error):
                raise
            # a standby refuses LISTEN: only polling shows the commits that it replays
            self._is_polling = True
        self._listening_on = driver
        self._due = 0.0  # if the following query fails, the next call repeats it
        return True

    def _on_notification(self, _: psycopg.Notify) -> None:
        self._is_hinted = True

    def _query_revision(self) -> None:
        # cleared before the query: a commit after its result sets it again
        self._is_hinted = False
        found, identity = self._connection.fetch(REVISION)
        if wire.read_int8(identity or b"") != self._identity:
            raise failures.remade(self._connection.shown)
        self.revision = wire.read_int8(found or b"")
        self._asked = time.monotonic()
        self._due = self._asked + (POLLING_S if self._is_polling else LISTENING_S)
