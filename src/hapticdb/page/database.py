"""The database behind the page: one thread has it open, and no thread of the page waits for it."""

import logging
import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import HapticDBError

LOG = logging.getLogger("hapticdb.page")
MOST_WAITING = 64
"""Jobs that wait."""
ENDS_WITHIN = 0.2
"""Seconds in which a thread without a job ends. Larger: it wakes less often."""

Answer = TypeVar("Answer")


class DatabaseThread:
    """An environment in a thread of its own, opened for the first of all browsers' jobs."""

    def __init__(self, url: str, *, read_only: bool = True) -> None:
        self._url, self._read_only = url, read_only
        self._env: Environment | None = None
        self._jobs: queue.Queue[Callable[[], None]] = queue.Queue(MOST_WAITING)
        self._is_ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="database", daemon=True)
        self._thread.start()

    def ask(
        self,
        job: Callable[[Environment], Answer],
        then: Callable[[Answer], Any],
        failed: Callable[[HapticDBError], Any],
    ) -> None:
        """Do a job later, in the database's thread; then call `then` or `failed` there, shortly."""

        def work() -> None:
            try:
                answer = job(self._opened())
            except HapticDBError as error:
                failed(error)
            else:
                then(answer)

        try:
            self._jobs.put_nowait(work)
        except queue.Full:
            failed(HapticDBError("the database is busy with other people's wishes: try again"))

    def close(self) -> None:
        """End the thread after the job that runs now."""
        self._is_ending.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        while not self._is_ending.is_set():
            try:
                self._jobs.get(timeout=ENDS_WITHIN)()
            except queue.Empty:
                continue
            except Exception:
                LOG.exception("a job of the page failed")
        if self._env is not None:
            self._env.close()

    def _opened(self) -> Environment:
        """The environment, which is opened if it is not yet open."""
        if self._env is None:
            self._env = open_environment(self._url, read_only=self._read_only)
        return self._env
