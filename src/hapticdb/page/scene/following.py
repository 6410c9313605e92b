"""The thread that owns the page's connection to the database: objects, changes, voxels."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from queue import Empty, SimpleQueue
from threading import Event, Thread
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import HapticDBError, ObjectNotFoundError
from hapticdb.grid import Grid
from hapticdb.ingest.layout import voxels_of_rows
from hapticdb.query.grouping import object_ranges
from hapticdb.resident.changes import writes_since
from hapticdb.store.base import Object, SupportsWatch

Answer = TypeVar("Answer")
LOOK_EVERY_S = 0.02
"""Seconds between two looks for commits of others. A larger value shows an edit later and asks the
database less often."""
TRY_AGAIN_S = 1.0
"""Seconds after a failed statement until the next look."""


@dataclass(frozen=True)
class Followed:
    """What was committed: states of the objects that were written, ids of those that are gone."""

    written: list[Object]
    removed: list[int]
    revision: int


@dataclass(frozen=True)
class _Question:
    ask: Callable[[Environment], Any]
    answer: "Future[Any]"

    def put_to(self, env: Environment) -> None:
        if self.answer.set_running_or_notify_cancel():
            try:
                self.answer.set_result(self.ask(env))
            except Exception as error:  # noqa: BLE001 - whoever asked is told, whatever it is
                self.answer.set_exception(error)


class Follower:
    """Opens an environment to read, and tells what is committed to it, in a thread of its own.

    Parameters
    ----------
    url : str
        The environment.
    tell : callable
        Takes `Followed`, from this thread: first all objects, then each change.

    """

    grid: Grid
    """The environment's grid, from `start` on."""

    def __init__(self, url: str, tell: Callable[[Followed], None]) -> None:
        self._url = url
        self._tell = tell
        self._jobs: SimpleQueue[_Question] = SimpleQueue()
        self._ended = Event()
        self._revisions: dict[int, int] = {}
        self._revision = -1
        self._opened: Future[None] = Future()
        self._thread = Thread(target=self._run, name="follower", daemon=True)

    def start(self) -> None:
        """Open the environment, tell all of its objects, and follow it from then on.

        Raises
        ------
        HapticDBError
            If the environment cannot be opened or read.
        """
        self._thread.start()
        self._opened.result()

    def close(self) -> None:
        """Close the connection and end the thread; questions that wait are cancelled."""
        self._ended.set()

    def join(self, timeout: float) -> None:
        """Wait until the thread has ended."""
        self._thread.join(timeout)

    def ask(self, question: Callable[[Environment], Answer]) -> "Future[Answer]":
        """Run a function with the environment in this thread; cancelled when the thread ends."""
        answer: Future[Answer] = Future()
        self._jobs.put(_Question(question, answer))
        if self._ended.is_set():
            answer.cancel()
        return answer

    def voxels(self, object_id: int, box: NDArray[np.float64] | None) -> Future[NDArray[np.int64]]:
        """Voxels (n, 3) of an object, or of its part in a box (2, 3), metres, world frame."""
        return self.ask(partial(voxels_in, object_id=object_id, box=box))

    # -- the thread --------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            env = open_environment(self._url, read_only=True)
        except BaseException as error:  # noqa: BLE001 - the caller raises it
            self._opened.set_exception(error)
            return
        self.grid = env.grid
        with env:
            try:
                if isinstance(env.store, SupportsWatch):
                    env.store.watch()
                self._catch_up(env)
            except BaseException as error:  # noqa: BLE001 - likewise
                self._opened.set_exception(error)
                return
            self._opened.set_result(None)
            wait = LOOK_EVERY_S
            while not self._ended.is_set():
                self._work(env, wait)
                try:
                    if _may_have_changed(env):
                        self._catch_up(env)
                    wait = LOOK_EVERY_S
                except HapticDBError:
                    wait = TRY_AGAIN_S  # a server that is away: what it missed is read later
                    self._revision = -1
            self._cancel_all()

    def _cancel_all(self) -> None:
        with suppress(Empty):
            while True:
                self._jobs.get_nowait().answer.cancel()

    def _work(self, env: Environment, seconds: float) -> None:
        """Answer questions, or wait for one."""
        try:
            self._jobs.get(timeout=seconds).put_to(env)
            while not self._ended.is_set():
                self._jobs.get_nowait().put_to(env)
        except Empty:
            return

    def _catch_up(self, env: Environment) -> None:
        """Tell what was committed since the known revision."""
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
                there = list(_those_there(env, ids))
                gone = ids - {obj.id for obj in there}
        written = [obj for obj in there if self._revisions.get(obj.id) != obj.revision]
        removed = [i for i in gone if self._revisions.pop(i, None) is not None]
        self._revisions.update({obj.id: obj.revision for obj in written})
        self._revision = revision
        self._tell(Followed(written, removed, revision))


def _may_have_changed(env: Environment) -> bool:
    """Whether something may have been committed since the last look."""
    return env.store.has_changed() if isinstance(env.store, SupportsWatch) else True


def _those_there(env: Environment, ids: Iterable[int]) -> Iterable[Object]:
    for object_id in sorted(ids):
        try:
            yield env.object(object_id)
        except ObjectNotFoundError:
            continue


def voxels_in(
    env: Environment, object_id: int, box: NDArray[np.float64] | None
) -> NDArray[np.int64]:
    """Voxels (n, 3) of an object, all or those in a box (2, 3), metres, world frame."""
    if box is None:
        return env.voxels(object_id)
    obj = env.object(object_id)
    both = np.stack([np.maximum(obj.bounds[0], box[0]), np.minimum(obj.bounds[1], box[1])])
    if (both[0] > both[1]).any():
        return np.empty((0, 3), dtype=np.int64)
    ranges = object_ranges(env.grid, env.layout, replace(obj, bounds=both))
    found = voxels_of_rows(env.store.rows_of(object_id, *ranges), env.grid, env.layout)
    low, high = env.grid.voxels_of(both)
    inside = ((found >= low) & (found <= high)).all(axis=1)
    return np.compress(inside, found, axis=0)
