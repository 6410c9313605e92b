"""Long jobs of a panel: a thread of the site, and a progress bar."""

import logging
import threading
from collections.abc import Callable
from typing import TypeVar

from viser import GuiApi

from hapticdb.errors import HapticDBError, UsageError
from hapticdb.kernels._sets import building
from hapticdb.page.browser import Browser, put
from hapticdb.page.wording import note_html

LOG = logging.getLogger("hapticdb.page")
Progress = Callable[[int, int], None]
"""Callback with the numbers of finished and of all steps; HapticDBError after a disconnect."""

Answer = TypeVar("Answer")
WAITS = "Waits for its turn."
COMPILES = "Compiling, once on this machine: about 10 s."


class PanelJob:
    """At most one job of a panel at a time, with its progress and result.

    what : name of the job; steps : plural of the steps in its progress.
    """

    def __init__(self, browser: Browser, gui: GuiApi, what: str, steps: str) -> None:
        self._browser, self._what, self._steps = browser, what, steps
        self._is_running = False
        self._doing = ""  # words of the job's state; empty: its result is shown
        self._lock = threading.Lock()
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self.said = gui.add_html("")
        browser.works.append(self)

    def begin(self, job: Callable[[Progress], Answer], show: Callable[[Answer], None]) -> None:
        """Queue a job; it and then `show` run in the site's thread for long jobs."""
        if self._is_running:
            raise UsageError(f"{self._what} is running: wait for it")
        # before the job waits in the queue: a second press meanwhile is refused
        self._is_running, self._doing = True, WAITS
        put(self._bar, 0.0)
        self._bar.visible = True

        def work() -> None:
            try:
                self._doing = "Reads the parts."
                answer = job(self._progress)
                self._say("")
                show(answer)
            except HapticDBError as error:
                self._say(self._browser.site.error_text(error))
            except Exception:
                LOG.exception("%s of the page failed", self._what)
                self._say("It failed; the operator's log says why.")
            finally:
                self._is_running = False
                self._bar.visible = False

        self._browser.site.sweeping.submit(work)

    def tick(self) -> None:
        """Show the job's state; called by the page's clock."""
        with self._lock:
            if self._doing:
                compiles = building and self._doing != WAITS
                said = note_html(COMPILES if compiles else self._doing)
                if self.said.content != said:
                    self.said.content = said

    def _say(self, words: str) -> None:
        """End the display of the job's state."""
        with self._lock:
            self._doing, self.said.content = "", note_html(words)

    def _progress(self, done: int, total: int) -> None:
        if self._browser.has_gone:
            raise HapticDBError("the browser has gone")
        percent = 100 * done // max(total, 1)
        put(self._bar, percent)
        self._doing = f"{total:,} {self._steps}: {percent} %"
