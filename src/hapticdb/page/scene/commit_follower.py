"""Follower of the environment's commits."""

from collections.abc import Callable
from concurrent.futures import Future
from threading import Event, Thread

from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import HapticDBError
from hapticdb.grid import Grid
from hapticdb.resident.changes import writes_since
from hapticdb.store.base import Object

POLL_EVERY_S = 0.02
"""Poll period, seconds."""


class Follower:
    """Thread calling `on_change` with written objects, removed ids and revision; first with all."""

    grid: Grid
    """The environment's grid, from `start` on."""

    def __init__(self, url: str, on_change: Callable[[list[Object], list[int], int], None]) -> None:
        self._url = url
        self._on_change = on_change
        self._ended = Event()
        self._revisions: dict[int, int] = {}
        self._revision = -1
        self._opened: Future[None] = Future()
        self._thread = Thread(target=self._run, name="follower", daemon=True)

    def start(self) -> None:
        """Open the environment, report all objects, and start polling; HapticDBError on failure."""
        self._thread.start()
        self._opened.result()

    def close(self) -> None:
        """Close the connection, and end the thread."""
        self._ended.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        try:
            with open_environment(self._url, read_only=True) as env:
                self.grid = env.grid
                env.store.watch()
                self._catch_up(env)
                self._opened.set_result(None)
                self._follow(env)
        except BaseException as error:
            if self._opened.done():
                raise
            self._opened.set_exception(error)  # the caller raises it

    def _follow(self, env: Environment) -> None:
        pause = POLL_EVERY_S
        while not self._ended.wait(pause):
            try:
                if env.store.has_changed():
                    self._catch_up(env)
                pause = POLL_EVERY_S
            except HapticDBError:
                pause = 1.0  # server unreachable: all objects are read again later
                self._revision = -1

    def _catch_up(self, env: Environment) -> None:
        """Report the commits since the last reported revision."""
        # revision and objects of one snapshot: a commit between them would be missed
        with env.store.snapshot():
            revision = env.store.revision()
            if revision == self._revision:
                return
            changes = writes_since(env.store, self._revision, revision)
            if changes is None:
                there = env.objects()
                gone = self._revisions.keys() - {obj.id for obj in there}
            else:
                ids = {change.id for change in changes}
                there = env.store.objects(ids)
                gone = ids - {obj.id for obj in there}
        # after a lost connection all objects are read: those already reported are left out
        written = [obj for obj in there if self._revisions.get(obj.id) != obj.revision]
        removed = [i for i in gone if self._revisions.pop(i, None) is not None]
        self._revisions.update({obj.id: obj.revision for obj in written})
        # after the reads: an error above leads to the same writes again
        self._revision = revision
        self._on_change(written, removed, revision)
