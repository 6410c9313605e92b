"""Database thread of the page, so that no other thread waits for the database."""

import logging
import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import HapticDBError

LOG = logging.getLogger("hapticdb.page")

Answer = TypeVar("Answer")


class DatabaseThread:
    """Thread with an environment, opened at the first job of any browser."""

    def __init__(self, url: str, *, read_only: bool = True) -> None:
        self._url, self._read_only = url, read_only
        self._env: Environment | None = None
        self._jobs: queue.Queue[Callable[[], None]] = queue.Queue(64)
        self._is_ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="database", daemon=True)
        self._thread.start()

    def submit(
        self,
        job: Callable[[Environment], Answer],
        then: Callable[[Answer], Any],
        failed: Callable[[HapticDBError], Any],
    ) -> None:
        """Queue a job; then `then` or `failed` is called in this thread, and must be short."""

        def work() -> None:
            try:
                if self._env is None:  # in this thread, the only one that may use it
                    self._env = open_environment(self._url, read_only=self._read_only)
                answer = job(self._env)
            except HapticDBError as error:
                failed(error)
            else:
                then(answer)

        try:
            # a full queue is an error, not a wait of the caller
            self._jobs.put_nowait(work)
        except queue.Full:
            failed(HapticDBError("the database is busy with other people's wishes: try again"))

    def close(self) -> None:
        """End the thread after its current job."""
        self._is_ending.set()
        self._thread.join(10.0)

    def _run(self) -> None:
        while not self._is_ending.is_set():
            try:
                self._jobs.get(timeout=0.2)()  # bounds the time to end the thread
            except queue.Empty:
                continue
            except Exception:
                LOG.exception("a job of the page failed")
        if self._env is not None:
            self._env.close()
