"""Damages sound files and reads them as an import does: ``python tests/mutate_files.py 50000``.

Each file must be read or be refused in one line: without a traceback or a hang, with at most ten
times the memory of the file and its result, and with sound geometry. A table counts what happened;
the exit code is 1 if a file broke one of these rules. File number n of a seed is the same on every
run: ``--only n`` makes it again and tells its result.

Meshes are read by `hapticdb.mesh.read_file`, with one difference: its child is forked from this
process, which has loaded the reader, instead of started anew, so a file takes milliseconds. Each
format has a process of its own, because a fork copies everything that is loaded.
"""

# ruff: noqa: T201 - a script that prints
import argparse
import io
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import IO, Any

import numpy as np

from children import finished
from file_mutations import mutated
from file_seeds import OTHERS, seeds
from hapticdb.errors import FileError, UsageError
from hapticdb.mesh import SUFFIXES, MeshFile, child, read_file, reader
from hapticdb.mesh.parse import reader_of

FORMATS = (*SUFFIXES, *OTHERS)

SLOWEST = 30.0
"""Seconds after which reading a file counts as a hang."""
BASE_BYTES = 64 << 20
"""Bytes that a file may take beyond ten times its size and the size of its result."""
SOUND = ("read", "refused", "library crashed, in one line")
peak = 0
"""Bytes that the last forked child took beyond what it shared with this process."""


class Forked:
    """Stands in for `subprocess.Popen` in `reader`: the child is a copy of this process."""

    def __init__(
        self, _command: Sequence[str], *, stderr: IO[bytes], env: dict[str, str], **_: object
    ) -> None:
        self.returncode: int | None = None
        request, answer = os.pipe(), os.pipe()
        self._before = _resident()
        self.pid = os.fork()
        if self.pid == 0:
            os.dup2(request[0], 0)
            os.dup2(answer[1], 1)
            os.dup2(stderr.fileno(), 2)
            for end in (*request, *answer):  # others stay: PROJ would close its own a second time
                os.close(end)
            os.environ.update(env)
            _run_child()
        os.close(request[0])
        os.close(answer[1])
        self.stdin, self.stdout = os.fdopen(request[1], "wb"), os.fdopen(answer[0], "rb")

    def kill(self) -> None:
        """End it, unless it has ended."""
        if self.returncode is None:
            os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> None:
        """Take its exit code; `kill` and the reader's clock see to its end."""
        global peak  # noqa: PLW0603 - one file at a time
        if self.returncode is None:
            _, status, usage = os.wait4(self.pid, 0)
            self.returncode = os.waitstatus_to_exitcode(status)
            peak = max(0, (usage.ru_maxrss << 10) - self._before)


def _resident() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def _run_child() -> None:
    """Run `child.py` as its own interpreter would. Never returns."""
    code = 1
    try:
        sys.stdin, sys.stderr = io.TextIOWrapper(io.FileIO(0)), io.TextIOWrapper(io.FileIO(2, "w"))
        child.main()
        code = 0
    except BaseException:  # noqa: BLE001 - told as the interpreter would
        traceback.print_exc(file=sys.stderr)
        sys.stderr.flush()
    finally:
        os._exit(code)


def in_fork(call: Callable[[], None], seconds: float) -> str:
    """Call a function in a forked child and return what happened."""
    global peak  # noqa: PLW0603
    before, ends = _resident(), os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            signal.setitimer(signal.ITIMER_REAL, seconds)
            try:
                call()
                word = "read"
            except (FileError, UsageError) as error:
                word = "refused" if "\n" not in str(error) else "several lines"
            except BaseException:  # noqa: BLE001 - what is looked for
                word = "traceback: " + traceback.format_exc(limit=-2)
            os.write(ends[1], word.encode()[:4000])
        finally:
            os._exit(0)
    os.close(ends[1])
    with os.fdopen(ends[0], "rb") as stream:
        word = stream.read().decode()
    _, status, usage = os.wait4(pid, 0)
    peak = max(0, (usage.ru_maxrss << 10) - before)
    if status:
        return "hang" if os.WTERMSIG(status) == signal.SIGALRM else f"killed by {status}"
    return word


def _read_ours(path: Path) -> None:
    if path.suffix == ".npz":
        from hapticdb import PointShell  # noqa: PLC0415

        shell = PointShell.load(path)
        assert np.isfinite(shell.points).all(), "points that are not finite"
    elif path.suffix == ".csv":
        from hapticdb.poses import read_timed_poses  # noqa: PLC0415

        _, poses = read_timed_poses(path)
        assert np.isfinite(poses).all(), "poses that are not finite"
    else:
        from hapticdb.recording.file import Recording  # noqa: PLC0415

        Recording(path).columns("time", "hand", "wrench", until_damage=True)


def _size_of(file: MeshFile) -> int:
    arrays = {
        id(a): a.nbytes for part in file.parts for a in (part.vertices, part.faces) if a is not None
    }
    return sum(arrays.values()) + sum(1000 + len(part.name) for part in file.parts)


def _unsound(file: MeshFile) -> str | None:
    for part in file.parts:
        if not (np.isfinite(part.bounds).all() and np.isfinite(part.world_from_part).all()):
            return "unsound: not finite"
        faces = np.empty(0, dtype=np.int64) if part.faces is None else part.faces
        if faces.min(initial=0) < 0 or faces.max(initial=-1) >= len(part.vertices):
            return "unsound: indices"
        if not len(part.vertices) or not part.name.isprintable():
            return "unsound: empty, or a name that cannot be printed"
    return None


def verdict(path: Path) -> tuple[str, str]:
    """The result of reading a file, and a line that describes it."""
    started, n_result, line = time.monotonic(), 0, ""
    if path.suffix in OTHERS:
        line = in_fork(lambda: _read_ours(path), SLOWEST)
        found = line.split(":")[0]
    else:
        try:
            file = read_file(path)
            n_result = _size_of(file)
            found = _unsound(file) or "read"
        except FileError as error:
            line = str(error)
            found = "library crashed, in one line" if " crashed on it " in line else "refused"
            if "ended with status" in line or "\n" in line:
                found = "traceback"
        except Exception:  # noqa: BLE001 - what is looked for
            found, line = "traceback", traceback.format_exc()
    if time.monotonic() - started > SLOWEST:
        found = "hang"
    if found in SOUND and peak > BASE_BYTES + 10 * (path.stat().st_size + n_result):
        found, line = "memory", f"{peak >> 20} MiB; {line}"
    return found, line


def make(number: int, seed: int, known: list[bytes]) -> bytes:
    """Content of file `number`, made from sound ones of its format."""
    random = Random(f"{seed} {number}")  # noqa: S311 - damages, no secrets
    suffix = FORMATS[number % len(FORMATS)]
    return mutated(random, suffix, random.choice(known), random.choice(known))


def run(suffix: str, numbers: Sequence[int], seed: int, folder: Path) -> Counter[str]:
    """Read damaged files of one format; return the counts of results."""
    known = seeds(suffix, folder)
    (folder / "beside.bin").write_bytes(bytes(48))
    path = folder / f"mutated{suffix}"
    path.write_bytes(known[0])
    if suffix in OTHERS:
        _read_ours(path)
    else:
        reader_of(path)
    popen, counts = subprocess.Popen, Counter[str]()
    reader.subprocess.Popen = Forked  # type: ignore[attr-defined]
    try:
        for n in numbers:
            path.write_bytes(make(n, seed, known))
            found, line = verdict(path)
            counts[found] += 1
            if found not in SOUND or len(numbers) == 1:
                size = path.stat().st_size
                print(f"file {n} ({suffix}, {size} bytes): {found}: {line[-1500:]}", flush=True)
    finally:
        reader.subprocess.Popen = popen  # type: ignore[attr-defined]
    return counts


def _run_apart(n_format: int, given: argparse.Namespace) -> Counter[str]:
    """Run one format in a process of its own; return its counts."""
    command = [sys.executable, __file__, str(given.files), f"--format={n_format}"]
    command.append(f"--seed={given.seed}")
    # a limit for a run that hangs, far above what the slowest files may take
    limit = 60 + SLOWEST * given.files
    ended = finished(command, stderr=None, patience=limit)
    *lines, last = ended.stdout.splitlines() or [""]
    print(*lines, sep="\n", end="\n" if lines else "", flush=True)
    if ended.returncode:
        print(last)
        return Counter({f"exit code {ended.returncode}": 1})
    return Counter(json.loads(last))


def table(counts: Counter[Any]) -> str:
    """The counts as text, one line for each format and result."""
    return "\n".join(f"{suffix:8}{word:30}{n:>10,}" for (suffix, word), n in counts.items())


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=int, nargs="?", default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="number of one file to make and read again")
    parser.add_argument("--format", type=int, help="number of one format to run")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    n_format = given.format if given.only is None else given.only % len(FORMATS)
    started = time.monotonic()
    if n_format is not None:
        numbers = range(n_format, given.files, len(FORMATS)) if given.only is None else [given.only]
        with tempfile.TemporaryDirectory(prefix="hapticdb-mutated-") as folder:
            print(json.dumps(run(FORMATS[n_format], numbers, given.seed, Path(folder))))
        return 0
    counts: Counter[Any] = Counter()
    for n, suffix in enumerate(FORMATS):
        counts.update({(suffix, word): times for word, times in _run_apart(n, given).items()})
    seconds = time.monotonic() - started
    print(table(counts))
    print(f"{given.files:,} files in {seconds:.0f} s, {1000 * seconds / given.files:.1f} ms each")
    return int(any(word not in SOUND for _, word in counts))


if __name__ == "__main__":
    sys.exit(main())
