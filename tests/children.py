"""Child processes of tests and other waits: each wait has a limit.

`child` and `finished` start processes and kill each with its group after `TIMEOUT`. The script
`watchdog` ends every process that is left when the run is over, however the run ended.
"""

import atexit
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any

import pytest

TIMEOUT = 300.0
"""Seconds after which a child is killed and a wait fails. It is many times what a test takes on a
busy machine, and less than the 20 minutes after which pytest itself ends (pyproject.toml)."""
RUN = "HAPTICDB_TEST_RUN"
"""Variable that names the run's folder in all processes that it starts."""
PIPE = subprocess.PIPE
_line: list[IO[bytes]] = []
"""What the watchdog listens to, once there is one."""
_shared: list[Path] = []
"""The folder that all processes of the run share, once it is known."""


def begin_run(shared: Path | None = None) -> None:
    """End all processes, servers and files of this run with it. To be called before any starts.

    `shared` is the `shared_folder` of the run of which this process is a part, if it is one.

    A run may have been started with SIGINT ignored (``make test &`` in a script, cron). From now on
    it receives SIGINT as a run in the foreground does, because children inherit ignored signals
    and `feel` asks which handler is set. So Ctrl-C in that script's terminal ends the run, too;
    ``setsid`` prevents that.
    """
    if _line:
        return
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # pytest's own folders stay: a person may look into them after the run
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", tempfile.gettempdir())
    # not below the folder of a run that started this one: a socket's path has at most 107 bytes
    root = os.environ["PYTEST_DEBUG_TEMPROOT"]
    folder = Path(tempfile.mkdtemp(prefix="hapticdb-run-", dir=root)).resolve()
    folder.chmod(0o711)  # servers run under another account and must be able to enter
    _shared.append(shared or folder)
    os.environ[RUN] = os.environ["TMPDIR"] = str(folder)
    tempfile.tempdir = None  # tempfile finds its folder again
    script = str(Path(__file__).with_name("watchdog.py"))
    dog = subprocess.Popen(
        [sys.executable, "-I", "-S", script, str(os.getpid()), str(folder)],
        stdin=PIPE,
        start_new_session=True,  # Ctrl-C and a kill of pytest's group do not reach the watchdog
    )
    assert dog.stdin is not None
    _line.append(dog.stdin)
    atexit.register(_end_run, dog, os.getpid())


def shared_folder() -> Path:
    """Folder that the processes of the run share: it ends, and what runs in it, with the run."""
    return _shared[0]


def _end_run(dog: "subprocess.Popen[bytes]", pid: int) -> None:
    if os.getpid() == pid:  # a forked copy of this process must not do it
        assert dog.stdin is not None
        dog.stdin.close()
        dog.wait(TIMEOUT)


def end_forked(pid: int) -> None:
    """Have a process that was forked without `exec` end with this run."""
    _line[0].write(b"%d\n" % pid)
    _line[0].flush()


@contextlib.contextmanager
def child(
    command: Sequence[str],
    *,
    timeout: float = TIMEOUT,
    **how: Any,  # noqa: ANN401 - as `subprocess.Popen` takes it; no input and pipes unless given
) -> Iterator["subprocess.Popen[str]"]:
    """A child process in a process group of its own. The end of the block waits for its end.

    The child is killed with its group when the block fails, and after `timeout`. Then all its
    pipes close, so no read from them waits for ever.
    """
    streams = {"stdin": subprocess.DEVNULL, "stdout": PIPE, "stderr": PIPE}
    process = subprocess.Popen(command, text=True, process_group=0, **streams | how)
    late = threading.Event()

    def give_up() -> None:
        late.set()
        _kill(process)

    timer = threading.Timer(timeout, give_up)
    timer.daemon = True
    timer.start()
    try:
        with process:
            try:
                yield process
            except BaseException:
                _kill(process)
                raise
    finally:
        timer.cancel()
        _kill(process)
    if late.is_set():
        pytest.fail(f"killed, since it did not end within {timeout:g} s: {command}")


def _kill(process: "subprocess.Popen[str]") -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def finished(
    command: Sequence[str],
    *,
    check: bool = False,
    timeout: float = TIMEOUT,
    **how: Any,  # noqa: ANN401 - as `child` takes it
) -> "subprocess.CompletedProcess[str]":
    """Run a child process to its end; return its exit code and what it printed."""
    with child(command, timeout=timeout, **how) as process:
        out, err = process.communicate(timeout=timeout)
    if check:
        assert process.returncode == 0, err
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def exit_code(pid: int) -> int:
    """Wait for the end of a forked process; return its exit code, negative after a signal."""
    end_forked(pid)
    found: list[int] = []

    def has_ended() -> bool:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            found.append(os.waitstatus_to_exitcode(status))
        return bool(ended)

    until(has_ended)
    return found[0]


def until(claim: Callable[[], object], every: float = 0.01, timeout: float = TIMEOUT) -> None:
    deadline = time.monotonic() + timeout
    while not claim():
        assert time.monotonic() < deadline, f"it does not hold after {timeout:g} s"
        time.sleep(every)


def descendants(pid: int) -> list[int]:
    """Processes that a process has started, and those that they have started."""
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):  # ended meanwhile
            for child in map(int, task.read_text().split()):
                found += [child, *descendants(child)]
    return found


def named(pid: int) -> str:
    """Name of a process; empty where it has ended."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


def joined(thread: threading.Thread) -> None:
    thread.join(TIMEOUT)
    assert not thread.is_alive(), f"it did not end within {TIMEOUT:g} s"


def received(connection: Connection) -> Any:  # noqa: ANN401 - whatever was sent
    assert connection.poll(TIMEOUT), f"no word within {TIMEOUT:g} s"
    return connection.recv()
