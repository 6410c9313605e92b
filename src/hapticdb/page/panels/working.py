"""Long jobs of a panel: a thread of the site, and a progress bar."""

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from hapticdb.errors import HapticDBError, UsageError
from hapticdb.page.browser import Browser
from hapticdb.page.widgets import put
from hapticdb.page.wording import note_html

if TYPE_CHECKING:
    from viser import GuiApi

LOG = logging.getLogger("hapticdb.page")
Progress = Callable[[int, int], None]
"""Callback with the numbers of finished and of all steps; HapticDBError after a disconnect."""

Answer = TypeVar("Answer")


class Work:
    """At most one job of a panel at a time, named `what`, with its progress and result."""

    def __init__(self, browser: Browser, gui: "GuiApi", what: str) -> None:
        self._browser, self._what = browser, what
        self._is_running = False
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self.said = gui.add_html("")

    def begin(self, job: Callable[[Progress], Answer], show: Callable[[Answer], None]) -> None:
        """Queue a job; it and then `show` run in the site's thread for long jobs."""
        if self._is_running:
            raise UsageError(f"{self._what} is running: wait for it")
        self._is_running = True
        put(self._bar, 0.0)
        self._bar.visible = True
        self.said.content = note_html("Waits for its turn.")

        def work() -> None:
            try:
                show(job(self._progress))
            except HapticDBError as error:
                self.said.content = note_html(self._browser.site.error_text(error))
            except Exception:
                LOG.exception("%s of the page failed", self._what)
                self.said.content = note_html("It failed; the operator's log says why.")
            finally:
                self._is_running = False
                self._bar.visible = False

        self._browser.site.sweeping.submit(work)

    def _progress(self, done: int, total: int) -> None:
        if self._browser.has_gone:
            raise HapticDBError("the browser has gone")
        put(self._bar, 100.0 * done / max(total, 1))
