"""Supervisor: records running sessions, notices dead workers, starts prefetch processes again."""

import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress

from hapticdb.closing import Closes
from hapticdb.errors import HapticDBError
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.running import Running
from hapticdb.session.shared_table import SharedTable

LOG = logging.getLogger("hapticdb.session")
POLL_EVERY = 0.05
"""Seconds between two checks of recordings and processes. Larger: less work, and a death is noticed
later. A recording loses frames from 2 s on."""


class Supervisor(Closes):
    """Running sessions of this process, supervised in two threads until `close`.

    shared : their slots, owned; cells : tables of cells in use now. sessions : by their numbers;
    failure : lasting error of a prefetch process, None without one.
    """

    def __init__(self, shared: SharedTable, cells: Callable[[], Iterable[ResidentCells]]) -> None:
        self.shared, self._cells = shared, cells
        self.sessions: dict[int, Running] = {}
        self.failure: HapticDBError | None = None
        self._is_closed = threading.Event()
        self._logged: set[str] = set()
        # two, because a slow start of a process must delay no recording
        self._threads = [
            threading.Thread(target=self._repeat, args=(look,), daemon=True, name="supervisor")
            for look in (self._supervise_sessions, self._supervise_cells)
        ]
        for thread in self._threads:
            thread.start()

    def _repeat(self, look: Callable[[], None]) -> None:
        while not self._is_closed.wait(POLL_EVERY):
            look()

    def _supervise_sessions(self) -> None:
        # a copy: sessions begin and end in other threads
        for running in list(self.sessions.values()):
            with self._surviving("recording a session"):
                # a dead worker writes no frame: its clients must not wait for one
                if running.worker.is_alive:
                    running.take_frames()
                else:
                    self.shared.lose(running.slot, running.session)

    def _supervise_cells(self) -> None:
        for cells in self._cells():
            with self._surviving("starting a prefetch process again"):
                try:
                    cells.supervise()
                except HapticDBError as error:
                    self.failure = error

    @contextmanager
    def _surviving(self, work: str) -> Iterator[None]:
        """Go on after an error; its first occurrence is logged."""
        try:
            yield
        except Exception as error:
            said = f"{work}: {type(error).__name__}: {error}"
            if said not in self._logged:
                self._logged.add(said)
                LOG.exception("%s failed; later errors of this kind are not logged", work)

    def close(self) -> None:
        """End the threads and all sessions, each even if another fails at it."""
        # threads first: none may read a slot that is freed below
        self._is_closed.set()
        for thread in self._threads:
            with suppress(RuntimeError):
                thread.join()
        with ExitStack() as ends:
            ends.callback(self.shared.close)
            for running in list(self.sessions.values()):
                ends.callback(running.end)
            self.sessions.clear()
