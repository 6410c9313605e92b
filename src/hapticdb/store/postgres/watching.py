"""How a reader learns that others have committed: LISTEN, and the revision as a net under it.

Each write notifies the environment's channel, with its revision as payload, in its transaction
(PostgreSQL's manual: NOTIFY). The server sends that to whoever listens, once it is committed; to
look whether it has come costs no round trip. Any role of the database may notify the channel, with
any payload: a notification is a hint to ask for the revision, which only editors can raise, and
nothing more; its payload is not read here. A server that refuses LISTEN, as a standby does, and
writers that do not notify are found out by asking for the revision now and then. So is an
environment that somebody has dropped and made anew: its table has another oid.
"""

import hashlib
import time

import psycopg

from hapticdb.errors import ConnectionLostError
from hapticdb.store.postgres import failures, wire
from hapticdb.store.postgres.address import LONGEST_NAME
from hapticdb.store.postgres.session import Session, identifier

REVISION = "SELECT revision, tableoid::bigint FROM environment WHERE id = 1"
DIGEST_DIGITS = 32
HEARING_S = 1.0
"""How long a writer that does not notify may go unnoticed where LISTEN works."""
DEAF_S = 0.02
"""How long any writer may, where it does not."""
HINTED_S = 0.005
"""Between two round trips that notifications lead to, at least: 200 a second in a flood."""


def channel_of(environment: str) -> str:
    """Name of an environment's channel, of 63 bytes at most; all share the database's channels."""
    channel = f"hapticdb_{environment}"
    if len(channel.encode()) <= LONGEST_NAME:
        return channel
    # a dot, where the others have their underscore: no other environment has the same
    return f"hapticdb.{hashlib.sha256(environment.encode()).hexdigest()[:DIGEST_DIGITS]}"


class Watch:
    """What one session has heard of the commits of others."""

    def __init__(self, session: Session, identity: int) -> None:
        self._session = session
        self._identity = identity
        self._connection: psycopg.Connection[tuple[object, ...]] | None = None
        self._revision = -1
        self._is_hinted = False
        self._is_deaf = True
        self._due = self._asked = 0.0

    def begin(self) -> None:
        """Notice commits from now on."""
        self._session.check_outside()
        self._session.again(self._listen)
        self._ask()

    def has_changed(self) -> bool:
        """Whether something was committed since `begin` or the last call.

        A round trip only after a notification, when the revision has not been asked for in a while,
        and after a lost connection: then the answer is yes, since what came meanwhile was not
        heard. Raises ConnectionLostError when the environment was made anew.
        """
        self._session.check_outside()
        if self._session.again(self._listen):
            self._ask()
            return True
        now = time.monotonic()
        is_hinted = self._is_hinted and now >= self._asked + HINTED_S
        return (is_hinted or now >= self._due) and self._ask()

    def _listen(self) -> bool:
        """Take in what has come; on a connection that does not listen yet, begin, and say so."""
        connection = self._session.connection
        if connection is self._connection:
            self._session.hear()
            return False
        connection.add_notify_handler(self._hear)
        channel = identifier(channel_of(self._session.address.environment))
        try:
            self._session.command(f"LISTEN {channel.as_string(connection)}")
            self._is_deaf = False
        except psycopg.Error as error:
            if failures.is_lost(error):
                raise
            self._is_deaf = True
        self._connection = connection
        self._due = 0.0  # should asking right after this fail, the next call asks
        return True

    def _hear(self, _: psycopg.Notify) -> None:
        self._is_hinted = True

    def _ask(self) -> bool:
        """Whether the revision is another than the one known."""
        before, self._is_hinted = self._revision, False  # before: what comes meanwhile may be newer
        found, identity = self._session.fetch(REVISION)
        if wire.read_int8(identity or b"") != self._identity:
            raise ConnectionLostError(
                f"{self._session.shown} is another environment than before: open it again"
            )
        self._revision = wire.read_int8(found or b"")
        self._asked = time.monotonic()
        self._due = self._asked + (DEAF_S if self._is_deaf else HEARING_S)
        return self._revision != before
