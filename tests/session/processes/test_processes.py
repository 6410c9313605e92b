"""A session's process reports what happened, and ends when its session ends."""

import contextlib
import gc
import os
import pickle
import resource
import signal
import socket
import sys
from pathlib import Path
from types import ModuleType

import pytest

from children import TIMEOUT, child, finished
from hapticdb.errors import DatabaseError, HapticDBError, UsageError
from hapticdb.resident.table import is_alive
from hapticdb.session.processes import process as module
from hapticdb.session.processes.channel import Message
from hapticdb.session.processes.process import Process
from session.sessions import until

WORKERS = "session.processes.workers:work"
LONG = TIMEOUT


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]), prepend=os.pathsep)


def test_process_messages_whole_and_in_order() -> None:
    large = list(range(100_000))
    with Process(WORKERS, ("echo", large), []) as process:
        assert process.receive(LONG) == Message("heard", large)
        word, content = process.receive(LONG) or ("", None)
        assert (word, content) == ("again", (large, process.pid))
        assert process.receive(LONG) is None
        assert process.wait(LONG)


def test_process_messages_with_many_open_files() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, before[1]), before[1]))
    with contextlib.ExitStack() as opened:
        opened.callback(resource.setrlimit, resource.RLIMIT_NOFILE, before)
        while opened.enter_context(Path(os.devnull).open()).fileno() < 1024:
            pass
        with Process(WORKERS, ("wait", None), []) as process:
            assert process.receive(LONG) == Message("waiting")
            assert process.receive(0.01) is None


def test_process_error_raised_in_parent() -> None:
    with (
        Process(WORKERS, ("fail", None), []) as process,
        pytest.raises(DatabaseError, match=r"^no such place: make it first$"),
    ):
        process.receive(LONG)


@pytest.mark.parametrize(
    ("word", "cause"),
    [
        ("break", "ZeroDivisionError: one$"),
        ("exit", "SystemExit: 3$"),
        ("end of file", "EOFError: of something else$"),
    ],
)
def test_process_unexpected_error_one_line(word: str, cause: str) -> None:
    with (
        Process(WORKERS, (word, None), []) as process,
        pytest.raises(HapticDBError, match=f"the session's process ended: {cause}"),
    ):
        process.receive(LONG)


def test_process_request_of_script_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Mine:
        pass

    Mine.__module__, Mine.__qualname__ = "of_a_script", "Mine"
    script = ModuleType("of_a_script")
    script.Mine = Mine  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "of_a_script", script)
    with (
        Process(WORKERS, Mine(), []) as process,
        pytest.raises(UsageError, match=r"of_a_script.*: define devices in a module"),
    ):
        process.receive(LONG)


def test_process_end_then_kill(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "END_TIMEOUT", 0.5)
    for word in ("wait", "measure", "hang"):
        process = Process(WORKERS, (word, None), [])
        assert process.receive(LONG) is not None
        monkeypatch.setattr(module, "END_TIMEOUT", 0.5 if word == "hang" else LONG)
        process.end()
        assert not process.is_alive
        process.end()


def test_process_sigterm_tidies_up() -> None:
    with Process(WORKERS, ("tidy", None), []) as process:
        assert process.receive(LONG) == Message("waiting")
        os.kill(process.pid, signal.SIGTERM)
        assert process.receive(LONG) == Message("tidied")
        assert process.receive(LONG) is None
        assert process.wait(LONG)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_process_truncated_request(share: float) -> None:
    start = f"run({WORKERS.partition(':')[0]!r}, 'work', os.pidfd_open(os.getppid()))"
    script = f"import os; from {module.__name__} import run; {start}"
    content = pickle.dumps(pickle.dumps(("echo", list(range(1000)))))
    whole = len(content).to_bytes(8, "little") + content
    ours, theirs = socket.socketpair()
    with theirs:
        with ours:
            ours.sendall(whole[: round(share * len(whole))])
        done = finished([sys.executable, "-c", script], stdin=theirs.fileno())
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_process_killed() -> None:
    with Process(WORKERS, ("hang", None), []) as process:
        assert process.receive(LONG) is not None
        os.kill(process.pid, signal.SIGKILL)
        assert process.receive(LONG) is None
        assert process.wait(LONG)
        assert not process.is_alive


SCRIPT = f"""
import os, time
from hapticdb.session.processes.process import Process
process = Process({WORKERS!r}, ("wait", None), [])
process.receive({LONG})
forked = os.fork() if {{forks}} else 0
if forked or not {{forks}}:
    print(process.pid, forked, flush=True)
time.sleep(1000)
"""


@pytest.mark.parametrize("forks", [False, True])
def test_process_ends_with_killed_parent(forks: bool) -> None:
    """Also when a process forked from the session holds the channel open."""
    args = [sys.executable, "-c", SCRIPT.format(forks=forks)]
    with child(args, stderr=None) as session:
        assert session.stdout is not None
        pid, forked = map(int, session.stdout.readline().split())
        session.kill()
        session.wait(TIMEOUT)
        try:
            until(lambda: not is_alive(pid))
        finally:
            if forks:
                os.kill(forked, signal.SIGKILL)


def test_process_fork_server_restarts() -> None:
    with Process(WORKERS, ("wait", None), []) as first:
        assert first.receive(LONG) == Message("waiting")
        os.kill(int(Path(f"/proc/{first.pid}/stat").read_text().split()[3]), signal.SIGKILL)
        with Process(WORKERS, ("wait", None), []) as second:
            assert second.receive(LONG) == Message("waiting")
            assert first.is_alive


def test_process_working_folder_and_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("one", "other"):
        folder = tmp_path / name
        folder.mkdir()
        monkeypatch.chdir(folder)
        monkeypatch.setenv("HAPTICDB_TEST_WORD", name)
        with Process(WORKERS, ("where", None), []) as process:
            assert process.receive(LONG) == Message("here", (str(folder), name))


def test_process_dropped_ends() -> None:
    process = Process(WORKERS, ("wait", None), [])
    assert process.receive(LONG) is not None
    pid = process.pid
    del process
    gc.collect()
    until(lambda: not is_alive(pid))
