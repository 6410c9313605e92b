"""Asks the primary for its revision again and again, in a thread with a connection of its own."""

import threading
import time
from collections import deque
from typing import NamedTuple

from hapticdb.errors import HapticDBError
from hapticdb.store.postgres.address import Address
from hapticdb.store.postgres.connecting import failures
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.watching import REVISION

ASK_EVERY_S = 0.1
"""Seconds between two questions. A larger value costs the primary less, and proofs are older."""
PAUSES_S = (0.05, 1.0)
"""Seconds until a lost primary is tried again: first and longest; each pause is twice the last."""
MOST_ANSWERS = 1024
"""Answers kept while the standby is behind them. A larger value proves the age of a standby that
is further behind; it is behind by more than a minute then."""


class ToldRevision(NamedTuple):
    """At the instant `asked_at` (ns of `time.monotonic_ns`) or later the primary had `revision`."""

    asked_at: int
    revision: int


class PrimaryQuestions:
    """The primary's revision over time. Made, used and closed by one thread; asks in another.

    Parameters
    ----------
    address : Address
        The environment.
    conninfo : str
        For libpq, of the primary alone.
    identity : int
        Of the environment that the standby has; answers of another one do not count.
    """

    def __init__(self, address: Address, conninfo: str, identity: int) -> None:
        self._address, self._conninfo, self._identity = address, conninfo, identity
        self._lock = threading.Lock()
        self._answers: deque[ToldRevision] = deque(maxlen=MOST_ANSWERS)
        self._newest = -1
        self._proved_at = 0
        self.failure: HapticDBError | None = None
        self._has_asked, self._ending = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._follow, name="primary", daemon=True)
        self._thread.start()

    def first(self, seconds: float) -> int | None:
        """Newest revision that the primary has told; waits for the first one, or for a failure.

        None after a failure, or if neither comes in so many seconds.
        """
        self._has_asked.wait(seconds)
        with self._lock:
            return self._newest if self._newest >= 0 else None

    def newest_at(self, revision: int) -> int:
        """Last instant at which the primary had no more than `revision`; 0 if none is known.

        Calls are to have ascending revisions.
        """
        with self._lock:
            while self._answers and self._answers[0].revision <= revision:
                self._proved_at = max(self._proved_at, self._answers.popleft().asked_at)
            return self._proved_at

    def close(self) -> None:
        """End the thread soon."""
        self._ending.set()

    def _follow(self) -> None:
        pause, longest = PAUSES_S
        while not self._ending.is_set():
            try:
                with ServerConnection(self._address, self._conninfo, read_only=True) as primary:
                    while not self._ending.is_set():
                        self._ask(primary)
                        pause = PAUSES_S[0]
                        self._ending.wait(ASK_EVERY_S)
            except (HapticDBError, OSError) as error:
                self._fail(error)
            self._ending.wait(pause)
            pause = min(2 * pause, longest)

    def _ask(self, primary: ServerConnection) -> None:
        """Ask once; not by `again`, which tries for seconds to connect."""
        asked_at = time.monotonic_ns()
        with failures.named_errors(self._address.shown):
            row = primary.execute(REVISION).fetchone()
        if row is None or row[1] != self._identity:
            raise HapticDBError("it has another environment of that name")
        with self._lock:
            if row[0] < self._newest:  # commits were lost: earlier answers prove nothing
                self._answers.clear()
            self._newest = row[0]
            self._answers.append(ToldRevision(asked_at, row[0]))
            self.failure = None
        self._has_asked.set()

    def _fail(self, error: HapticDBError | OSError) -> None:
        with self._lock:
            self.failure = error if isinstance(error, HapticDBError) else HapticDBError(str(error))
        self._has_asked.set()
