"""Ends what a run of the tests has left, however the run ended: its processes, servers and files.

`children.begin_run` starts this script beside pytest, in a session of its own. It waits for the end
of its input, which also comes when pytest is killed and can tidy up nothing itself. It needs Linux.

Each line of its input is a word and a value: ``folder PATH``, below which servers are ended;
``process PID``, one that was forked. All others are known by the variable HAPTICDB_TEST_RUN.
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
"""Between looks whether pytest is there: a process that it has forked may hold the line open."""
PATIENCE_S = 20.0
"""For a server to shut down; after that it is killed."""


def identity_of(pid: int) -> tuple[int, str] | None:
    """Number and start time of a living process: the same number may be another's later."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else (pid, fields[19])


def processes() -> Iterator[tuple[int, list[str], list[str]]]:
    """Id, command line and first environment of each living process but this one."""
    for path in Path("/proc").glob("[0-9]*"):
        pid = int(path.name)
        if pid == os.getpid() or identity_of(pid) is None:
            continue
        with contextlib.suppress(OSError):
            words, variables = ((path / name).read_bytes() for name in ("cmdline", "environ"))
            yield pid, os.fsdecode(words).split("\0"), os.fsdecode(variables).split("\0")


class Leftovers:
    """What a run may have left.

    Parameters
    ----------
    run : Path
        The run's folder, which is removed; named by HAPTICDB_TEST_RUN in all that the run starts.
    """

    def __init__(self, run: Path) -> None:
        self._run = run
        self._folders = [run]
        self._forked: set[tuple[int, str]] = set()

    def note(self, line: bytes) -> None:
        """Take a line of the input in."""
        word, _, value = os.fsdecode(line).partition(" ")
        if word == "folder":
            self._folders.append(Path(value))
        elif (found := identity_of(int(value))) is not None:
            self._forked.add(found)

    def end(self) -> None:
        """End all of it, servers last: none is there then to start another."""
        deadline = time.monotonic() + PATIENCE_S
        mark = f"HAPTICDB_TEST_RUN={self._run}"
        n_quiet, asked, folders = 0, set[int](), set[Path]()
        while n_quiet < 2:  # between two processes, one may start the other
            is_late = time.monotonic() > deadline
            found = list(processes())
            servers = {pid: data for pid, words, _ in found if (data := self._data_of(words))}
            others = {pid for pid, _, variables in found if mark in variables}
            others |= {pid for pid, start in self._forked if identity_of(pid) == (pid, start)}
            for pid in others:
                _send(pid, signal.SIGKILL)
            for pid in servers.keys() if is_late else servers.keys() - asked:
                _send(pid, signal.SIGKILL if is_late else signal.SIGQUIT)
            asked.update(servers)
            folders.update(servers.values())
            n_quiet = 0 if servers or others else n_quiet + 1
            if is_late and time.monotonic() > deadline + PATIENCE_S:
                break  # not to be killed: stuck in the system
            time.sleep(0.05)
        for folder in (*folders, self._run):
            shutil.rmtree(folder, ignore_errors=True)

    def _data_of(self, words: list[str]) -> Path | None:
        """Data folder of a PostgreSQL that runs, or is being set up, below our folders."""
        if "-D" not in words[:-1]:
            return None
        data = Path(words[words.index("-D") + 1])
        return data if any(map(data.is_relative_to, self._folders)) else None


def _send(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def watch(parent: int, leftovers: Leftovers) -> None:
    """Read the input until it ends, or the parent does."""
    rest = b""
    while True:
        is_orphan = os.getppid() != parent  # asked before: what it said is in the pipe by now
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
