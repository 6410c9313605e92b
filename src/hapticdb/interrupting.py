"""Ctrl-C at any moment of the command line: one line, exit code 130, no traceback.

An exception that a signal raises comes anywhere: within an import it may end as another error, or
as a traceback that Python prints and forgets. So, until a verb begins, Ctrl-C ends the process at
once, since nothing is open yet; later it waits until no import is under way.
"""

import os
import signal
import sys
import threading
from types import FrameType
from typing import Literal

EXIT_CODE = 130
WORDS = b"hapticdb: interrupted\n"
AGAIN_S = 0.01
"""Seconds after which an interrupt that met an import is tried again."""

Phase = Literal["not ours", "starting", "working", "leaving"]
_phase: Phase = "not ours"


def begin() -> None:
    """Answer Ctrl-C from now on; nothing is changed where somebody else does, or nobody is to."""
    global _phase  # noqa: PLW0603 - a process has one Ctrl-C
    is_main = threading.current_thread() is threading.main_thread()
    if is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
        sys.unraisablehook = _note_unraisable
        _phase = "starting"


def work() -> None:
    """Raise KeyboardInterrupt from now on: a verb begins, and has to leave in order."""
    global _phase  # noqa: PLW0603
    if _phase == "starting":
        _phase = "working"


def leave() -> None:
    """Take no notice of one more Ctrl-C: the verb has ended, and its exit code stands."""
    global _phase  # noqa: PLW0603
    if _phase != "not ours":
        _phase = "leaving"
        signal.setitimer(signal.ITIMER_REAL, 0.0)  # an alarm ends what has no handler any more


def interrupt(number: int, frame: FrameType | None) -> None:
    """Answer a signal; a handler."""
    global _phase  # noqa: PLW0603
    if _phase == "starting":
        os.write(2, WORDS)
        os._exit(EXIT_CODE)
    if _phase == "leaving":
        _phase = "starting"  # who asks twice is not kept waiting
    elif _is_importing(frame) and _try_again():
        pass
    else:
        raise KeyboardInterrupt(number)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _try_again() -> bool:
    """Have the handler called again soon; whether that can be."""
    if signal.getsignal(signal.SIGALRM) not in {signal.SIG_DFL, interrupt}:
        return False
    signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    return True


def _note_unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    """Try an interrupt again that Python could not raise, from a finalizer; print all else."""
    is_interrupt = issubclass(unraisable.exc_type, KeyboardInterrupt)
    if not is_interrupt or (_phase == "working" and not _try_again()):
        sys.__unraisablehook__(unraisable)
