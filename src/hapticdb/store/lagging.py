"""Stores whose answers may come from a copy that follows the database later.

Such a store proves how old an answer may be. Without a proof, what it answers counts as older than
any limit.
"""

from typing import NamedTuple, Protocol, runtime_checkable


class Lag(NamedTuple):
    """How far a standby is behind its primary.

    replayed : position in the primary's log up to which the standby has replayed it; bytes : of the
    log that the primary has written and the standby has not replayed; seconds : the standby has
    everything that was committed so many seconds ago, by the primary's own clock; writes : to the
    environment that it has not replayed. The last three are None where `unknown` says why.
    """

    replayed: str
    bytes: int | None = None
    seconds: float | None = None
    writes: int | None = None
    unknown: str | None = None


@runtime_checkable
class MayLag(Protocol):
    """An engine that may read from a standby."""

    def begin_proofs(self) -> None:
        """Have answers proved from now on, if they come from a standby.

        Raises StaleError when nothing can be proved now: the primary cannot be asked, or the
        standby is behind.
        """

    def newest_at(self, revision: int) -> int | None:
        """Last instant known at which `revision` had everything that was committed. Never waits.

        In nanoseconds of `time.monotonic_ns`; 0 if no instant is known. None if all answers since
        the last call came from the database itself: each has what was committed when it was asked
        for.
        """

    def lag(self) -> Lag | None:
        """How far the server that answers is behind; None if it is no standby. May take seconds."""
