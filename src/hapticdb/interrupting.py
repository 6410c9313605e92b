"""Ctrl-C at any moment of the command line: one line, exit code 130, no traceback.

A signal may raise its exception in any line of code. Within an import it may turn into another
error, or into a traceback that Python prints and ignores. Within llvmlite it may have an object
freed twice: one line passes the object to LLVM, and the next one notes the transfer. Until a verb
begins, nothing is open, so Ctrl-C ends the process at once. Afterwards the interrupt waits until
neither is running.
"""

import os
import signal
import sys
import threading
from types import FrameType
from typing import Literal

EXIT_CODE = 130
MESSAGE = b"hapticdb: interrupted\n"
AGAIN_S = 0.01
"""Seconds until the next try of a delayed interrupt."""

LLVMLITE = f"{os.sep}llvmlite{os.sep}"
"""In the paths of llvmlite's modules."""

Phase = Literal["not ours", "starting", "working", "leaving"]
_phase: Phase = "not ours"


def begin() -> None:
    """Handle Ctrl-C from now on, unless the signal has another handler already, or is ignored."""
    global _phase  # noqa: PLW0603 - a process has one Ctrl-C
    is_main = threading.current_thread() is threading.main_thread()
    if is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)
        sys.unraisablehook = _note_unraisable
        _phase = "starting"


def work() -> None:
    """Raise KeyboardInterrupt from now on: a verb begins, and cleans up after an interrupt."""
    global _phase  # noqa: PLW0603
    if _phase == "starting":
        _phase = "working"


def leave() -> None:
    """Ignore one more Ctrl-C: the verb has ended, and its exit code is decided."""
    global _phase  # noqa: PLW0603
    if _phase != "not ours":
        _phase = "leaving"
        # without a handler the alarm would end the process
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def print_message() -> None:
    """Write the one line, independent of the state of the program's streams."""
    os.write(2, MESSAGE)


def interrupt(_number: int, frame: FrameType | None) -> None:
    """Signal handler: raise KeyboardInterrupt or end the process, depending on the phase."""
    global _phase  # noqa: PLW0603
    if _phase == "starting":
        print_message()
        os._exit(EXIT_CODE)
    if _phase == "leaving":
        _phase = "starting"  # a second Ctrl-C ends the process at once
    elif _must_wait(frame) and _try_again():
        pass
    else:
        raise KeyboardInterrupt  # without the number: SIGALRM's would be read as a message


def _must_wait(frame: FrameType | None) -> bool:
    """Whether an import or llvmlite is running."""
    while frame is not None:
        file = frame.f_code.co_filename
        if file.startswith("<frozen importlib") or LLVMLITE in file:
            return True
        frame = frame.f_back
    return False


def _try_again() -> bool:
    """Schedule the handler after `AGAIN_S`; False if the alarm has another handler."""
    if signal.getsignal(signal.SIGALRM) not in {signal.SIG_DFL, interrupt}:
        return False
    signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    return True


def _note_unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    """Raise an interrupt from within a finalizer again; print every other exception."""
    is_interrupt = issubclass(unraisable.exc_type, KeyboardInterrupt)
    if not is_interrupt or (_phase == "working" and not _try_again()):
        sys.__unraisablehook__(unraisable)
