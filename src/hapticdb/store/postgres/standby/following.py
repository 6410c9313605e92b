"""How old the answers of a standby are: proved by the primary, never by the standby alone.

A standby that is cut off, or told to wait, answers its old revision as readily as a new one. Its
own views do not help: an idle primary and a lost one are equally silent for many seconds, and what
they show of the primary needs rights and the clocks of two machines. So the primary itself is asked
for its revision, ten times a second, on a connection of its own.

Writes take their revisions under a lock that they hold until they are committed. So if the primary,
asked at the instant t, had the revision R, each write that was committed before t has a revision up
to R; and a standby in which R is visible has replayed all of them. Cells of the revision R or a
later one were up to date at t. Only the clock of this machine is read, which never goes back.

Assumed: the server that takes writes is the one that says so and that the URL leads to; the standby
replays the log of that server, or of one that has the same history. A standby that has replayed
commits which the primary has lost (after a failover or a restore) must be rebuilt.
"""

import time
from collections.abc import Callable

from hapticdb.errors import HapticDBError, StaleError
from hapticdb.store.engines import Lag
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.standby.aiming import at_primary
from hapticdb.store.postgres.standby.asking import PrimaryQuestions

FIRST_ANSWER_S = 12.0
"""Longest time to wait for the primary's first answer. It is longer than one host may take to
accept a connection. A larger value lets the URL name several hosts that do not answer."""
CATCH_UP_S = 0.5
"""Longest time to wait for a standby to replay what the primary had when it was first asked. A
larger value begins with a standby that is further behind."""
LOOK_EVERY_S = 0.005
"""Seconds between looks at the standby meanwhile."""
POSITION = """
SELECT pg_current_wal_flush_lsn()::text, clock_timestamp()::text,
       (SELECT revision FROM environment WHERE id = 1)"""
REPLAYED = """
SELECT pg_last_wal_replay_lsn()::text,
       pg_wal_lsn_diff(%s::pg_lsn, pg_last_wal_replay_lsn())::bigint,
       extract(epoch FROM %s::timestamptz - pg_last_xact_replay_timestamp())::float8,
       (SELECT revision FROM environment WHERE id = 1)"""


class Following:
    """Proofs for one connection, which may lead to a standby, and to another server after a loss.

    Parameters
    ----------
    connection : ServerConnection
        The connection that reads.
    identity : int
        Of the environment.
    revision : callable
        Asks that connection for its revision.
    """

    def __init__(
        self, connection: ServerConnection, identity: int, revision: Callable[[], int]
    ) -> None:
        self._connection = connection
        self._identity = identity
        self._revision = revision
        self._questions: PrimaryQuestions | None = None
        self._source = self._present_source()

    def _present_source(self) -> tuple[object, bool]:
        """The connection to a server, and whether that server is a standby now."""
        return self._connection.driver, self._connection.is_standby

    def begin(self) -> None:
        """Have answers proved from now on, if they come from a standby.

        Raises
        ------
        StaleError
            When the primary cannot be asked, or the standby is behind by more than `CATCH_UP_S`.
        """
        if not self._connection.is_standby:
            return
        questions = self._asked()
        wanted = questions.first(FIRST_ANSWER_S)
        if wanted is None:
            raise self._unproved(questions)
        until = time.monotonic() + CATCH_UP_S
        while (found := self._revision()) < wanted:
            if time.monotonic() > until:
                raise StaleError(
                    f"{self._connection.shown}: the standby that answers has replayed the revision "
                    f"{found}, its primary has {wanted}: try again when 'hapticdb info' says that "
                    "it has caught up"
                )
            time.sleep(LOOK_EVERY_S)

    def newest_at(self, revision: int) -> int | None:
        """Last instant known at which `revision` had all commits; None on the primary.

        Where the answers come from another server than at the last call, they are mixed, and none
        is known.
        """
        before, self._source = self._source, self._present_source()
        if self._source != before:
            return 0
        if not self._connection.is_standby:
            self.close()
            return None
        return self._asked().newest_at(revision)

    def close(self) -> None:
        """Ask the primary no more."""
        if self._questions is not None:
            self._questions.close()
            self._questions = None

    def _asked(self) -> PrimaryQuestions:
        """Questions to the primary, begun when they are first needed."""
        if self._questions is None:
            here = self._connection
            conninfo = at_primary(here.conninfo)
            self._questions = PrimaryQuestions(here.address, conninfo, self._identity)
        return self._questions

    def _unproved(self, questions: PrimaryQuestions) -> StaleError:
        cause = questions.failure or f"no answer within {FIRST_ANSWER_S:g} s"
        return StaleError(
            f"{self._connection.shown}: a standby answers, and only its primary knows how old the "
            f"rows are: name the primary in the URL, too, as in postgresql://standby,primary/NAME"
            f"?target_session_attrs=prefer-standby ({cause})"
        )

    # -- for people ------------------------------------------------------------------------------

    def lag(self) -> Lag | None:
        """How far the standby is behind; None if the connection leads to no standby."""
        here = self._connection
        if not here.is_standby:
            return None
        try:
            conninfo = at_primary(here.conninfo)
            with ServerConnection(here.address, conninfo, read_only=True) as primary:
                ((written, clock, revision),) = primary.rows(POSITION)
        except HapticDBError as error:
            ((replayed, *_),) = here.rows(REPLAYED, ("0/0", "now"))
            return Lag(replayed, unknown=f"the primary does not answer: {error}")
        until = time.monotonic() + CATCH_UP_S
        while True:
            ((replayed, behind, seconds, found),) = here.rows(REPLAYED, (written, clock))
            if behind <= 0:
                return Lag(replayed, 0, 0.0, 0)
            if time.monotonic() > until:
                return Lag(replayed, behind, seconds, max(revision - found, 0))
            time.sleep(LOOK_EVERY_S)
