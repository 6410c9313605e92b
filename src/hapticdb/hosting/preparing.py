"""Kernels of hands, compiled while the page is shown already, in a process of its own."""

import asyncio
import os
import signal
import threading
import time
from collections.abc import Callable

from hapticdb.errors import HapticDBError
from hapticdb.kernels.compiling import Compiled, compile_missing, entries_for, missing
from hapticdb.ready import seconds_of
from hapticdb.realtime.processes import MessageSender, Process, parent_is_gone

LOOKED_EVERY = 0.2
"""Seconds from one look for the server's end to the next. Larger: compiling ends later."""

NICE = 10
"""Of the processes that compile: the page is drawn first. Larger: it waits less for them."""


class Preparation:
    """Compiles the kernels of some purposes, once, when somebody first waits for them.

    note, tell : called in the event loop with words on the progress, if anything has to be
    compiled: `note` when more is compiled, `tell` also when only the time left is another.
    """

    def __init__(
        self,
        purposes: tuple[str, ...],
        note: Callable[[str], object],
        tell: Callable[[str], object],
    ) -> None:
        self._purposes, self._note, self._tell = purposes, note, tell
        self._running = asyncio.Lock()
        self._is_done = False
        self._is_ending = threading.Event()

    async def done(self) -> None:
        """Wait until kernels are compiled, or `close`; HapticDBError or OSError."""
        async with self._running:
            if not self._is_done and not self._is_ending.is_set():
                await asyncio.to_thread(self._compile, asyncio.get_running_loop())
                self._is_done = True

    def _compile(self, loop: asyncio.AbstractEventLoop) -> None:
        names = missing(entries_for(*self._purposes))
        if not names:
            return
        over, now = time.monotonic() + seconds_of(names), Compiled(0, len(names))
        told, said = -1, ""
        with Process("hapticdb.hosting.preparing:work", self._purposes, ()) as process:
            while not self._is_ending.is_set():
                text = progress_text(now, over - time.monotonic())
                if text != said:
                    loop.call_soon_threadsafe(self._tell, text)
                    if now.done != told:
                        loop.call_soon_threadsafe(self._note, text)
                    told, said = now.done, text
                message = process.receive(LOOKED_EVERY)
                if message is None and process.wait(0.0):
                    raise HapticDBError("the process that compiles kernels ended too early")
                if message is not None and message.word == "done":
                    return
                now = message.content if message is not None else now

    def close(self) -> None:
        """End the compiling, if it runs."""
        self._is_ending.set()


def progress_text(now: Compiled, left: float) -> str:
    """Words on how far the compiling is; left : seconds still expected; may be negative."""
    text = f"compiling what the hand needs, once: {now.done} of {now.total}"
    if now.done == now.total:
        return text
    when = f"about {max(left, 1.0):.0f} s left" if left > 0.0 else "longer than expected"
    return f"{text}, {when}"


def work(purposes: tuple[str, ...], sender: MessageSender) -> None:
    """Compile what is missing; the work of the process, which ends with the server."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.nice(NICE)
    compile_missing(entries_for(*purposes), lambda now: sender.send("compiled", now))
    sender.send("done")


def _end_with_parent() -> None:
    """Raise an exit in the main thread when the server has ended: that ends the workers, too."""
    while not parent_is_gone():
        time.sleep(LOOKED_EVERY)
    os.kill(os.getpid(), signal.SIGTERM)
