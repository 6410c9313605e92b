"""Notices the commits of others: one thread with a store of its own, for all clients."""

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable

from hapticdb.errors import HapticDBError
from hapticdb.server.cells.limits import BEAT_S
from hapticdb.store.base import Store, SupportsWatch
from hapticdb.store.connect import open_store

LOOK_EVERY_S = 1e-3
"""Seconds between looks for a commit. Larger: an edit is felt later, an idle server does less."""
AGAIN_S = 0.25
"""Seconds until a lost database is tried again. Larger: it comes back later."""


class Watcher:
    """What the database says of its revision, followed in a thread.

    Parameters
    ----------
    url : str
        The environment.
    tell : callable
        Called in the event loop after each new revision, and when another environment has taken
        the place of this one.

    Attributes
    ----------
    revision : int
        The newest revision known; -1 before the first.
    confirmed_at : float
        When the database last answered, as of `time.monotonic`.
    identity : object
        Of the environment that is there now; None before it was opened.
    """

    def __init__(self, url: str, tell: Callable[[], None]) -> None:
        self._url = url
        self._tell = tell
        self._loop = asyncio.get_running_loop()
        self._ending = threading.Event()
        self.revision = -1
        self.confirmed_at = float("-inf")
        self.identity: object = None
        self._thread = threading.Thread(target=self._follow, name="cells-watcher", daemon=True)
        self._thread.start()

    @property
    def is_confirmed(self) -> bool:
        """Whether the database has answered lately."""
        return time.monotonic() - self.confirmed_at < 2 * BEAT_S

    def stop(self) -> None:
        """End the thread soon."""
        self._ending.set()

    def _follow(self) -> None:
        """Follow the environment until the end, even if its database goes and comes back."""
        while not self._ending.is_set():
            store = None
            with contextlib.suppress(HapticDBError, OSError):
                store = open_store(self._url, read_only=True)
                self._follow_opened(store)
            if store is not None:
                with contextlib.suppress(HapticDBError, OSError):
                    store.close()
            self._ending.wait(AGAIN_S)

    def _follow_opened(self, store: Store) -> None:
        if isinstance(store, SupportsWatch):
            store.watch()
        if store.identity != self.identity:
            self.identity, self.revision = store.identity, -1
        self._found(store.revision())
        while not self._ending.wait(LOOK_EVERY_S):
            has_changed = isinstance(store, SupportsWatch) and store.has_changed()
            if has_changed or time.monotonic() - self.confirmed_at > BEAT_S / 2:
                self._found(store.revision())

    def _found(self, revision: int) -> None:
        is_new = revision != self.revision
        self.revision = revision
        self.confirmed_at = time.monotonic()
        if is_new:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._tell)
