"""Removes the processes, servers and files that a test run has left, however the run ended.

`children.begin_run` starts this script beside pytest, in a session of its own. The script waits for
the end of its input, which also comes when pytest is killed and cannot clean up. It needs Linux.

Each line of its input is the id of a forked process. Servers run in the run's folder; other
processes have the variable HAPTICDB_TEST_RUN.
"""

import contextlib
import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

TICK_S = 0.5
"""Seconds between checks that pytest lives; a process forked from it may hold the pipe open."""
TIMEOUT_S = 20.0
"""Seconds for a server to shut down; after that it is killed."""


def identity_of(pid: int) -> tuple[int, str] | None:
    """Number and start time of a living process; the number alone may be reused later."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else (pid, fields[19])


def processes() -> Iterator[tuple[int, list[str], list[str]]]:
    """Id, command line and initial environment of each living process except this one."""
    for path in Path("/proc").glob("[0-9]*"):
        pid = int(path.name)
        with contextlib.suppress(OSError):
            words, variables = ((path / name).read_bytes() for name in ("cmdline", "environ"))
            if pid != os.getpid() and identity_of(pid) is not None:
                yield pid, os.fsdecode(words).split("\0"), os.fsdecode(variables).split("\0")


class Leftovers:
    """Processes, servers and files that a run may have left.

    Parameters
    ----------
    run : Path
        The run's folder, which is removed; the run's processes have it in HAPTICDB_TEST_RUN.
    """

    def __init__(self, run: Path) -> None:
        self._run = run
        self._forked: set[tuple[int, str]] = set()

    def note(self, line: bytes) -> None:
        """Store the process that a line of the input names."""
        if (found := identity_of(int(line))) is not None:
            self._forked.add(found)

    def end(self) -> None:
        """End processes until two searches in a row find none; then remove the folder."""
        deadline = time.monotonic() + TIMEOUT_S
        mark = f"HAPTICDB_TEST_RUN={self._run}"
        n_quiet, asked = 0, set[int]()
        while n_quiet < 2:  # a process may have started another between two looks
            is_late = time.monotonic() > deadline
            found = list(processes())
            servers = {pid for pid, words, _ in found if self._is_server(words)}
            others = {pid for pid, _, variables in found if mark in variables}
            others |= {pid for pid, start in self._forked if identity_of(pid) == (pid, start)}
            for pid in others:
                _send(pid, signal.SIGKILL)
            for pid in servers if is_late else servers - asked:
                _send(pid, signal.SIGKILL if is_late else signal.SIGQUIT)
            asked.update(servers)
            n_quiet = 0 if servers or others else n_quiet + 1
            if is_late and time.monotonic() > deadline + TIMEOUT_S:
                break  # cannot be killed: stuck in the kernel
            time.sleep(0.05)
        shutil.rmtree(self._run, ignore_errors=True)

    def _is_server(self, words: list[str]) -> bool:
        """Whether a PostgreSQL runs or is set up in the run's folder."""
        return "-D" in words[:-1] and Path(words[words.index("-D") + 1]).is_relative_to(self._run)


def _send(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def watch(parent: int, leftovers: Leftovers) -> None:
    """Read the input until it ends or the parent has ended."""
    rest = b""
    while True:
        is_orphan = os.getppid() != parent  # asked before the last read of the pipe
        ready, _, _ = select.select([0], [], [], 0 if is_orphan else TICK_S)
        if ready:
            read = os.read(0, 1 << 16)
            *lines, rest = (rest + read).split(b"\n")
            for line in lines:
                leftovers.note(line)
            if not read:
                return
        elif is_orphan:
            return


if __name__ == "__main__":
    left = Leftovers(Path(sys.argv[2]))
    watch(int(sys.argv[1]), left)
    left.end()
