"""A server for the processes of sessions: its copies begin with numba and kernels loaded.

A process has one fork server from its first `Process` on. The server is a plain ``python -c``, so a
user's script needs no ``if __name__ == "__main__"`` guard. It opens no database and no device, and
has one thread, so its copies are sound. It ends with its owner.
"""

import atexit
import contextlib
import errno
import fcntl
import gc
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from hapticdb.errors import HapticDBError
from hapticdb.session.processes.channel import Channel

ANSWER_TIMEOUT = 300.0
"""Seconds for the server's answer: it may load numba and compile. Larger: a caller waits longer for
a hung server."""


class Order(NamedTuple):
    """Work and surroundings of a process.

    work : function, as ``package.module:function``; with_kernels : whether the server loads its
    module and kernels before the fork; numbers : of its descriptors, or None for no process yet;
    path, environment, most_files : as in the owner.
    """

    work: str
    with_kernels: bool
    numbers: tuple[int, ...] | None
    path: list[str]
    environment: dict[str, str]
    most_files: tuple[int, int]


def _order(work: str, numbers: Sequence[int] | None, *, with_kernels: bool) -> Order:
    """An order for a process with the surroundings of this one."""
    return Order(
        work,
        with_kernels,
        None if numbers is None else tuple(numbers),
        sys.path,
        dict(os.environ),
        resource.getrlimit(resource.RLIMIT_NOFILE),
    )


# -- in the process that is served -----------------------------------------------------------------


class _ForkServer:
    """The fork server of this process, from its own side."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        ours.settimeout(ANSWER_TIMEOUT)
        self.channel = Channel(ours)
        call = f"from {__name__} import serve; serve({theirs.fileno()}, {os.getpid()})"
        with theirs:
            self._popen = subprocess.Popen(  # noqa: S603 - our own module, by this interpreter
                [sys.executable, "-c", call],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                # Ctrl-C in a terminal goes to a whole process group; only the owner handles it
                start_new_session=True,
            )

    def end(self) -> None:
        """End the server at once; its copies go on."""
        self.channel.close()
        self._popen.kill()
        self._popen.wait()


_server: _ForkServer | None = None
_lock = threading.Lock()


def _forget() -> None:
    """In a forked copy: the server is its parent's, and the lock may be locked for ever."""
    global _server, _lock
    _server, _lock = None, threading.Lock()


os.register_at_fork(after_in_child=_forget)


def _known() -> _ForkServer:
    global _server  # noqa: PLW0603 - one a process
    if _server is None:
        _server = _ForkServer()
    return _server


@atexit.register
def _end() -> None:
    global _server  # noqa: PLW0603 - one a process
    if _server is not None:
        _server.end()
    _server = None


def prepare(work: str, *, with_kernels: bool) -> None:
    """Have the server load a function's module, or its kernels, too, and go on here.

    To be called as early as possible before a process is started.
    """
    with _lock:
        try:
            _known().channel.send(_order(work, None, with_kernels=with_kernels))
        except OSError:  # `start` tries again, and tells what is wrong
            _end()


def start(
    work: str, streams: Sequence[int], numbers: Sequence[int], *, with_kernels: bool
) -> tuple[int, int]:
    """Start a process for a function.

    work, with_kernels : as for `Order`; streams : descriptors of its standard input, output and
    errors; numbers : more descriptors, with the same numbers there. Returns its process id, and its
    descriptor (pidfd). Raises OSError if the machine has no room for another process, HapticDBError
    if the server does not answer.
    """
    wanted = _order(work, numbers, with_kernels=with_kernels)
    # a descriptor, not a path: the folder may be renamed before the fork
    folder = os.open(".", os.O_PATH)
    try:
        number, standing = _answered(wanted, [*streams, folder, *numbers])
    finally:
        os.close(folder)
    if not standing:
        raise OSError(number, os.strerror(number))
    return number, standing[0]


def _answered(wanted: Order, descriptors: Sequence[int]) -> tuple[int, list[int]]:
    """Give an order and wait for the answer; a killed server is replaced once."""
    with _lock:
        for is_last in (False, True):
            try:
                channel = _known().channel
                channel.send(wanted, descriptors)
                return channel.receive()
            except TimeoutError as error:
                _end()
                raise HapticDBError(
                    f"no process was started in {ANSWER_TIMEOUT:g} s: this machine is too slow now"
                ) from error
            except (ConnectionError, EOFError) as error:
                _end()
                if is_last:
                    raise HapticDBError(
                        "no process can be started (Linux 5.3 or newer?): the errors are above"
                    ) from error
            except BaseException:
                _end()  # its answer would be taken for that of the next order
                raise
    raise AssertionError


# -- in the server ---------------------------------------------------------------------------------


def serve(descriptor: int, owner: int) -> None:
    """Run the server of the process `owner`, until it ends or closes the channel."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(ProcessLookupError):
        owning = os.pidfd_open(owner)
        # the owner may have died before the pidfd, and another process have its id
        if os.getppid() == owner:
            _serve(Channel(socket.socket(fileno=descriptor)), owning)


def _serve(channel: Channel, owning: int) -> None:
    children: dict[int, int] = {}
    events = select.poll()
    for number in (channel.sock.fileno(), owning):
        events.register(number, select.POLLIN)
    while True:
        for number, _ in events.poll():
            if number in children:
                os.waitpid(children.pop(number), 0)
                events.unregister(number)
                os.close(number)
                continue
            if number == owning:
                return
            try:
                wanted, descriptors = channel.receive()
            except (EOFError, OSError):
                return
            if wanted.with_kernels or wanted.numbers is None:
                _load(wanted.work, with_kernels=wanted.with_kernels)
            if wanted.numbers is None:
                continue
            try:
                pid, child = _forked(wanted, descriptors, owning)
            except OSError as error:
                channel.send(error.errno or errno.EAGAIN)
            else:
                children[child] = pid
                events.register(child, select.POLLIN)
                channel.send(pid, [child])
            for received in descriptors:
                os.close(received)


def _load(work: str, *, with_kernels: bool) -> None:
    """Load a function's module, and kernels; the process itself reports errors."""
    with contextlib.suppress(Exception):
        import_module(work.partition(":")[0])
        if with_kernels:
            import_module("hapticdb.kernels._jit").load_entries()
        # copy on write: a collection writes to the header of each tracked object
        gc.freeze()  # collections in copies leave these pages shared


def _forked(wanted: Order, descriptors: list[int], owning: int) -> tuple[int, int]:
    """Fork a process; its id and its descriptor (pidfd)."""
    pid = os.fork()
    if pid == 0:
        try:
            _become(wanted, descriptors, owning)
        except BaseException:  # noqa: BLE001 - nothing of the server may run in the copy
            traceback.print_exc()
        finally:
            os._exit(1)
    return pid, os.pidfd_open(pid)


def _become(wanted: Order, descriptors: list[int], owning: int) -> None:
    """In the copy: take on the order's surroundings, and run the function."""
    os.setsid()
    resource.setrlimit(resource.RLIMIT_NOFILE, wanted.most_files)
    targets = [0, 1, 2, *(wanted.numbers or ())]
    # first above all targets, then down: a direct dup2 could close a source that is still needed
    first = max(targets) + 1
    owning, *descriptors = [fcntl.fcntl(n, fcntl.F_DUPFD, first) for n in (owning, *descriptors)]
    os.fchdir(descriptors.pop(3))
    for number, target in zip(descriptors, targets, strict=True):
        os.dup2(number, target)
    # the copy must hold no channel of a sibling: its end of file would never come
    kept = [*sorted(targets), owning]
    for below, above in zip(kept, [*kept[1:], wanted.most_files[0]], strict=True):
        os.closerange(below + 1, above)
    module, name = wanted.work.split(":")
    with contextlib.suppress(OSError):  # a name for `ps`, no more
        Path("/proc/self/comm").write_text(f"hdb-{module.rpartition('.')[2]}")
    os.environ.clear()
    os.environ.update(wanted.environment)
    sys.path[:] = wanted.path
    import_module("hapticdb.session.processes.process").run(module, name, owning)
