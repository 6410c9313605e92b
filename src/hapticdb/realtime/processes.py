"""Processes of a real-time session: each gets a request and sends messages over a pipe.

Each process is a copy of the fork server (`fork_server`) and calls one function. The request and
the messages are pickles, exchanged only between a process and what it has started.
"""

import contextlib
import os
import pickle
import select
import signal
import sys
import time
import weakref
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import IO, Any, BinaryIO, NamedTuple, Self

from hapticdb.errors import HapticDBError, UsageError
from hapticdb.realtime.fork_server import start

END_PATIENCE = 5.0
"""Seconds that a process has to end by itself before it is killed. Larger: slower devices can
close, a hanging process delays the end longer."""
_ends = select.poll()
"""Tells that the process that started this one has ended, or has closed the pipe."""


class Message(NamedTuple):
    """A message of a process: a word for its kind, and its content."""

    word: str
    content: Any = None


class Process:
    """One process of a session, used by the process that started it.

    Parameters
    ----------
    work : str
        Function that the process calls, as ``package.module:function``; its arguments are the
        request and a `MessageSender`.
    request : object
        Argument of that function; picklable.
    descriptors : sequence of int
        File descriptors that the process inherits, under the same numbers.
    purposes : sequence of str
        What it calls kernels for (`kernels.compiling.PURPOSES`). It begins with them loaded, and
        with the function's module; by default with neither.
    """

    def __init__(
        self, work: str, request: object, descriptors: Sequence[int], purposes: Sequence[str] = ()
    ) -> None:
        content = pickle.dumps(request)
        self._buffer = b""
        (theirs, ours), (received, sent) = os.pipe(), os.pipe()
        try:
            self.pid, self._standing = start(work, purposes, [theirs, sent, 2], descriptors)
        except BaseException:
            os.close(ours)
            os.close(received)
            raise
        finally:
            os.close(theirs)
            os.close(sent)
        self._input, self._output = os.fdopen(ours, "wb"), os.fdopen(received, "rb", buffering=0)
        with contextlib.suppress(BrokenPipeError):  # the child died at once; `receive` reports that
            self._input.write(content)
            self._input.flush()
        # The input stays open: when it closes, the child knows that this process has ended. The
        # pipes of an unreferenced object would stay open, so the finalizer closes them.
        weakref.finalize(self, _close, self._input, self._output)
        weakref.finalize(self, os.close, self._standing)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return not self.wait(0.0)

    def receive(self, seconds: float) -> Message | None:
        """Return the next message, or None if none comes in `seconds` or the process has ended.

        Raises
        ------
        HapticDBError
            If the process ended with this error.
        """
        descriptor = self._output.fileno()
        until = time.monotonic() + seconds
        arrived = select.poll()  # `select` refuses descriptors from 1024 on
        arrived.register(descriptor, select.POLLIN)
        while True:
            message = self._take()
            if message is not None:
                break
            left = until - time.monotonic()
            if not arrived.poll(max(1000.0 * left, 0.0)):
                return None
            read = os.read(descriptor, 1 << 16)
            if not read:
                return None
            self._buffer += read
        if message.word == "error":
            raise message.content
        return message

    def _take(self) -> Message | None:
        """Take the first message out of the buffer, if it is complete."""
        if len(self._buffer) < 8:
            return None
        size = int.from_bytes(self._buffer[:8], "little")
        if len(self._buffer) < 8 + size:
            return None
        content, self._buffer = self._buffer[8 : 8 + size], self._buffer[8 + size :]
        message = pickle.loads(content)  # noqa: S301 - from our own child
        assert isinstance(message, Message)  # noqa: S101 - nothing else is sent
        return message

    def send(self, content: object) -> None:
        """Send an object, which the process takes by `receive_from_parent`; nothing if it ended."""
        with contextlib.suppress(OSError, ValueError):  # `receive` reports that
            self._input.write(pickle.dumps(content))
            self._input.flush()

    def wait(self, seconds: float) -> bool:
        """Wait for the end of the process; returns whether it ended in `seconds`."""
        ended = select.poll()
        ended.register(self._standing, select.POLLIN)
        return bool(ended.poll(1000.0 * seconds))

    def end(self) -> None:
        """End the process: close its input, and kill it if it does not end then."""
        _close(self._input, self._output)
        if not self.wait(END_PATIENCE):
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._standing, signal.SIGKILL)
            self.wait(END_PATIENCE)


def _close(*pipes: IO[bytes]) -> None:
    """Close the pipes to a process, which ends when its input is closed."""
    for pipe in pipes:
        with contextlib.suppress(OSError):
            pipe.close()


class _EndQuietly(SystemExit):
    """Ends the process without a message: after a signal, or because the parent has ended."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


class MessageSender:
    """Sends messages from a process to the one that started it."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def send(self, word: str, content: object = None) -> None:
        """Send a message; does nothing if no process can receive it any more."""
        packed = pickle.dumps(Message(word, content))
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(len(packed).to_bytes(8, "little") + packed)
            self._stream.flush()


def run(module: str, name: str, starter: int) -> None:
    """Run the request in the process that `Process` started, and end that process.

    `starter` is a descriptor that stands for the process that used `Process`.
    """
    for descriptor in (0, starter):
        _ends.register(descriptor, select.POLLIN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    status = 0
    sender = MessageSender(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # output of drivers must not mix with messages
    try:
        signal.signal(signal.SIGTERM, _end)
        function: Callable[[Any, MessageSender], None] = getattr(import_module(module), name)
        function(_request(), sender)
    except _EndQuietly as ended:
        status = ended.status
    except HapticDBError as error:
        sender.send("error", error)
    except BaseException as error:  # noqa: BLE001 - the parent waits, and must learn of any error
        import traceback  # noqa: PLC0415 - only now

        traceback.print_exc()
        cause = str(error).partition("\n")[0]
        sender.send(
            "error", HapticDBError(f"the session's process ended: {type(error).__name__}: {cause}")
        )
    sys.stderr.flush()
    os._exit(status)  # exit handlers would remove resources that other processes still use


def _end(number: int, _: object) -> None:
    """Signal handler: raise an exit, so that each `finally` runs and no device keeps its force."""
    signal.signal(number, signal.SIG_IGN)  # a second signal must not interrupt the clean-up
    raise _EndQuietly(128 + number)


def _load() -> Any:  # noqa: ANN401 - whatever was sent
    """Read the next object that the parent has sent."""
    try:
        return pickle.load(sys.stdin.buffer)  # noqa: S301 - from our own parent
    except (EOFError, pickle.UnpicklingError):  # the parent ended while it was sending
        raise _EndQuietly(0) from None


def receive_from_parent() -> Any:  # noqa: ANN401 - whatever was sent
    """Next object that the parent has sent by `Process.send`; a SystemExit if the parent ended.

    A process that waits for objects cannot ask `parent_is_gone`.
    """
    return _load()


def _request() -> object:
    """Read the request of the process; a UsageError if a module that it names cannot be found."""
    try:
        return _load()
    except (AttributeError, ImportError) as error:
        raise UsageError(
            f"a session's process cannot find what it was given ({error}): define devices in a "
            "module that can be imported, not in the script itself"
        ) from error


def parent_is_gone() -> bool:
    """Whether the process that started this one has ended, or has closed the pipe.

    Processes that were forked from it may still hold the pipe open.
    """
    return bool(_ends.poll(0))
