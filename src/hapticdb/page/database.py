"""The database behind the page: one thread has it open, and no thread of the page waits for it."""

import logging
import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from hapticdb.environment import Environment
from hapticdb.errors import HapticDBError
from hapticdb.page.folders import AllowedFolders, FoldersEnvironment
from hapticdb.store.connect import open_store

LOG = logging.getLogger("hapticdb.page")
MOST_WAITING = 64
"""Jobs that wait. Larger: more clicks of many people are kept while one job takes long, instead of
being refused."""
ENDS_WITHIN = 0.2
"""Seconds in which a thread without a job ends. Larger: it wakes less often."""

Answer = TypeVar("Answer")


def opened(url: str, folders: AllowedFolders | None, *, read_only: bool = True) -> Environment:
    """Open an environment; objects' files are read below these folders only, if any are given."""
    store = open_store(url, read_only=read_only)
    return Environment(store) if folders is None else FoldersEnvironment(store, folders)


class DatabaseThread:
    """An environment, opened in a thread of its own, that does the jobs of all browsers in turn.

    Parameters
    ----------
    url : str
        The environment.
    read_only : bool
        Whether its jobs only read.
    folders : AllowedFolders or None
        Where its jobs may read objects' files; None: everywhere.
    opens_later : bool
        Whether the environment is opened for the first job, and for each later one again while it
        cannot be; such a job fails. Else it is opened now, and the caller waits for it.

    Raises
    ------
    DatabaseError
        If the environment cannot be opened now.
    """

    def __init__(
        self,
        url: str,
        *,
        read_only: bool = True,
        folders: AllowedFolders | None = None,
        opens_later: bool = False,
    ) -> None:
        self._url, self._read_only, self._folders = url, read_only, folders
        self._opens_later = opens_later
        self._env: Environment | None = None
        self._jobs: queue.Queue[Callable[[], None]] = queue.Queue(MOST_WAITING)
        self._is_ending = threading.Event()
        self._is_ready = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="database", daemon=True)
        self._thread.start()
        if opens_later:
            return
        self._is_ready.wait()
        if self._error is not None:
            raise self._error

    def ask(
        self,
        job: Callable[[Environment], Answer],
        then: Callable[[Answer], Any],
        failed: Callable[[HapticDBError], Any],
    ) -> None:
        """Do a job later, in the database's thread; then call `then` or `failed` there.

        Parameters
        ----------
        job : callable
            Gets the environment.
        then, failed : callable
            Get its result, or its error; they should be short.
        """

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
        try:
            if not self._opens_later:
                self._opened()
            self._is_ready.set()
            while not self._is_ending.is_set():
                self._turn()
        except BaseException as error:
            self._error = error
            if self._is_ready.is_set():
                LOG.exception("the page's database thread ended")
        finally:
            self._is_ready.set()
            if self._env is not None:
                self._env.close()

    def _opened(self) -> Environment:
        """The environment, which is opened if it is not yet open."""
        if self._env is None:
            self._env = opened(self._url, self._folders, read_only=self._read_only)
        return self._env

    def _turn(self) -> None:
        """Do a job if there is one within the time."""
        try:
            job = self._jobs.get(timeout=ENDS_WITHIN)
        except queue.Empty:
            return
        try:
            job()
        except Exception:
            LOG.exception("a job of the page failed")
