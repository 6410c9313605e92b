"""Processes of a real-time session: each gets a request and sends messages over a `Channel`.

Each process is a copy of the fork server (`fork_server`) and calls one function. The request and
the messages go only between a process and its parent.
"""

import contextlib
import os
import pickle
import select
import signal
import socket
import sys
import weakref
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, Self

from hapticdb.errors import HapticDBError, UsageError
from hapticdb.session.processes.channel import Channel, Message
from hapticdb.session.processes.fork_server import start

END_TIMEOUT = 5.0
"""Seconds for a process to end by itself before it is killed. Larger: slower devices can close, a
hung process delays the end longer."""
START_TIMEOUT = 120.0
"""Seconds until a process must be ready: a device may take long to open. Larger: a caller waits
longer for a hung process."""
POLL_EVERY = 0.25
"""Seconds between two checks of a process for its parent."""
_ends = select.poll()
"""Becomes readable when the parent has ended, or has closed its channel."""
_parent: Channel | None = None
"""To the parent."""


class Process:
    """One process of a session, in its parent.

    work : function as ``package.module:function``, called with the request and a `MessageSender`;
    descriptors : inherited under the same numbers; with_kernels : begin with the function's module
    and its kernels loaded.
    """

    def __init__(
        self, work: str, request: object, descriptors: Sequence[int], *, with_kernels: bool = False
    ) -> None:
        content = pickle.dumps(request)
        sock, theirs = socket.socketpair()
        channel = self._channel = Channel(sock)
        try:
            streams = [theirs.fileno(), 2, 2]
            self.pid, self._standing = start(work, streams, descriptors, with_kernels=with_kernels)
        except BaseException:
            channel.close()
            raise
        finally:
            # only the child holds this end now: its death is an end of file here
            theirs.close()
        with contextlib.suppress(OSError):  # the child died at once; `receive` reports that
            channel.send(content)
        # the channel of an unreferenced object would stay open, and its process would go on
        weakref.finalize(self, channel.close)
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
        """Next message; None if none comes in `seconds` or the process has ended.

        Raises the error with which the process ended.
        """
        arrived = select.poll()  # `select` refuses descriptors from 1024 on
        arrived.register(self._channel.sock, select.POLLIN)
        if not arrived.poll(max(1000.0 * seconds, 0.0)):
            return None
        try:
            message, _ = self._channel.receive()
        except (EOFError, OSError):
            return None
        assert isinstance(message, Message)  # noqa: S101 - nothing else is sent
        if message.word == "error":
            raise message.content
        return message

    def await_ready(self, name: str) -> Any:  # noqa: ANN401 - what was sent
        """Content of the first message; without one the process is ended, and an error raised."""
        try:
            ready, is_slow = self.receive(START_TIMEOUT), self.is_alive
        except BaseException:
            self.end()
            raise
        if ready is not None:
            return ready.content
        self.end()
        raise HapticDBError(
            f"the {name} process was not ready after {START_TIMEOUT:g} s: the database or this "
            "machine is too slow now; try again"
            if is_slow
            else f"the {name} process did not start: its errors are above"
        )

    def send(self, content: object) -> None:
        """Send an object for `receive_from_parent` there; does nothing after its end."""
        with contextlib.suppress(OSError):  # `receive` reports that
            self._channel.send(content)

    def wait(self, seconds: float) -> bool:
        """Wait for the end of the process; returns whether it ended in `seconds`."""
        ended = select.poll()
        # a pidfd, not the pid: the child is the fork server's, and a pid may be reused
        ended.register(self._standing, select.POLLIN)
        return bool(ended.poll(1000.0 * seconds))

    def end(self, timeout: float = END_TIMEOUT) -> None:
        """End the process: close its channel, and kill it if it runs `timeout` s later."""
        # the end of file asks the process to stop: its `finally` blocks still run
        self._channel.close()
        if not self.wait(timeout):
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._standing, signal.SIGKILL)
            self.wait(END_TIMEOUT)


class _EndQuietly(SystemExit):
    """Ends the process without a message: after a signal, or because the parent has ended."""


class MessageSender:
    """Sends messages from a process to its parent."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel

    def send(self, word: str, content: object = None) -> None:
        """Send a message; does nothing if no process can receive it any more."""
        with contextlib.suppress(OSError):
            self._channel.send(Message(word, content))


def run(module: str, name: str, starter: int) -> None:
    """Run the request of a `Process` in its process, and end this process.

    starter : descriptor (pidfd) of the parent.
    """
    global _parent  # noqa: PLW0603 - one a process
    _parent = Channel(socket.socket(fileno=os.dup(0)))
    _ends.register(_parent.sock, 0)  # its end, which is always told
    # and its death: a forked copy of the parent would keep the channel open
    _ends.register(starter, select.POLLIN)
    # Ctrl-C is the parent's: this process ends with its channel
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    status = 0
    sender = MessageSender(_parent)
    try:
        signal.signal(signal.SIGTERM, _end)
        function: Callable[[Any, MessageSender], None] = getattr(import_module(module), name)
        function(_request(), sender)
    except _EndQuietly as ended:
        status = int(ended.code or 0)
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
    """Signal handler: raise an exit, so each `finally` runs and no device keeps its force."""
    signal.signal(number, signal.SIG_IGN)  # a second signal must not interrupt the clean-up
    raise _EndQuietly(128 + number)


def receive_from_parent() -> Any:  # noqa: ANN401 - whatever was sent
    """Next object from the parent's `Process.send`; a SystemExit if the parent ended."""
    assert _parent is not None  # noqa: S101 - `run` was called
    try:
        return _parent.receive()[0]
    except (EOFError, OSError):  # it may have ended while it was sending
        raise _EndQuietly(0) from None


def reply_to_parent(do: Callable[[Message, list[int]], Any], seconds: float) -> None:
    """Do a request of the parent, if one comes in `seconds`; see `Channel.reply`."""
    assert _parent is not None  # noqa: S101 - `run` was called
    if select.select([_parent.sock], [], [], seconds)[0]:
        _parent.reply(do)


def _request() -> object:
    """Read the request of the process; a UsageError if one of its modules is missing."""
    try:
        return pickle.loads(receive_from_parent())  # noqa: S301 - from our own parent
    except (AttributeError, ImportError) as error:
        raise UsageError(
            f"a session's process cannot find what it was given ({error}): define devices in a "
            "module that can be imported, not in the script itself"
        ) from error


def parent_is_gone(seconds: float = 0.0) -> bool:
    """Whether the parent has ended, or has closed its channel; waits up to `seconds`.

    Its forked copies may still have the channel open.
    """
    return bool(_ends.poll(1000.0 * seconds))
