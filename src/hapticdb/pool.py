"""Environments ready for use by many threads, such as those of a web service."""

import contextlib
import os
from collections.abc import Iterator
from queue import Empty, LifoQueue

from hapticdb.closing import Closes
from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import BusyError, ConnectionLostError, DatabaseError, UsageError
from hapticdb.store.threads import NOBODY, this_thread


class Pool(Closes):
    """A limited number of open environments of one database, lent to threads one at a time.

    Opening costs a connection, the statistics and the cost model. In a pool each member pays them
    once. A borrower gets the member that was given back last: its caches are the warmest.

    Parameters
    ----------
    url : str or path
        As for `hapticdb.open`.
    size : int
        Most members. The first is opened at once, the others when they are needed.
    read_only : bool
        Refuse every write.
    timeout : float
        Seconds that a borrower waits when all members are lent.

    Examples
    --------
    >>> pool = hapticdb.Pool("postgresql:///plant", size=4)       # doctest: +SKIP
    >>> with pool.environment() as env:                           # doctest: +SKIP
    ...     env.touch(shell, pose)
    """

    def __init__(
        self,
        url: str | os.PathLike[str],
        size: int = 8,
        *,
        read_only: bool = True,
        timeout: float = 30.0,
    ) -> None:
        if size < 1:
            raise UsageError(f"a pool of size {size}: give 1 or more")
        self._url, self._size = url, size
        self._is_read_only, self._timeout = read_only, _checked(timeout)
        self._is_closed = False
        self._free: LifoQueue[Environment | None] = LifoQueue()
        """Members that nobody has; None for each that may still be opened."""
        for _ in range(size - 1):
            self._free.put(None)
        first = self._opened()
        self._shown = first.url
        self._take_back(first, is_sound=True)

    def __repr__(self) -> str:
        return f"Pool({self._shown!r}, size={self._size})"

    def close(self) -> None:
        """Close all members; lent members are closed when they are given back."""
        self._is_closed = True
        with contextlib.suppress(Empty):
            while True:
                _close(self._free.get_nowait())
        self._free.put(None)  # wakes who waits, who puts it back for the next one

    @contextlib.contextmanager
    def environment(self, timeout: float | None = None) -> Iterator[Environment]:
        """Lend an environment to this thread inside a ``with``. Do not use it afterwards.

        timeout : seconds to wait when all members are lent, by default the pool's. `BusyError` when
        no member was given back in that time, `DatabaseError` when the pool is closed, or a new
        member cannot be opened.
        """
        env = self._taken(self._timeout if timeout is None else _checked(timeout))
        is_sound = True
        try:
            yield env
        except ConnectionLostError:
            raise  # the member stays: it connects again by itself, and keeps its statistics
        except DatabaseError:
            is_sound = False
            raise
        finally:
            self._take_back(env, is_sound=is_sound)

    def _taken(self, timeout: float) -> Environment:
        """Take a member that is free, or a new one; waits for one of the two."""
        try:
            env = self._free.get(timeout=timeout)
        except Empty:
            raise BusyError(
                f"all {self._size} environments of the pool of {self._shown} were in use "
                f"for {timeout:g} s: give them back sooner, or make the pool larger"
            ) from None
        if self._is_closed:
            _close(env)
            self._free.put(None)
            raise DatabaseError(f"the pool of {self._shown} has been closed: make a new one")
        if env is not None:
            env.store.give_to(this_thread())
            return env
        try:
            return self._opened()
        except BaseException:
            self._free.put(None)
            raise

    def _take_back(self, env: Environment, *, is_sound: bool) -> None:
        """Make a member free again. A broken or closed one is dropped: a new one may replace it."""
        if is_sound and not env.store.is_closed:
            env.store.give_to(NOBODY)  # a borrower that still uses it gets an error
            self._free.put(env)
        else:
            _close(env)
            self._free.put(None)
        if self._is_closed:
            self.close()

    def _opened(self) -> Environment:
        return open_environment(self._url, read_only=self._is_read_only)


def _checked(timeout: float) -> float:
    """Seconds to wait; UsageError if they are negative or no number."""
    if not timeout >= 0:
        raise UsageError(f"timeout {timeout}: give seconds, 0 or more")
    return timeout


def _close(env: Environment | None) -> None:
    if env is not None:
        env.store.give_to(this_thread())
        env.close()
