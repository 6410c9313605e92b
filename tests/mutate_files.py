"""Damages sound files and reads them as an import does: ``python tests/mutate_files.py 50000``.

Each file must be read or be refused in one line: without a traceback or a hang, with at most ten
times the memory of the file and its result, and with sound geometry. A table counts what happened;
the exit code is 1 if a file broke one of these rules. File number n of a seed is the same on every
run: ``--only n`` makes it again and tells its result.

Each file is read in a fork of a process that has loaded the reader, under the limit of memory of an
import's child, so that a file takes milliseconds. Each format has a process of its own, because a
fork copies everything that is loaded.
"""

# ruff: noqa: T201 - a script that prints
import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from children import finished
from file_mutations import mutated
from file_seeds import OTHERS, seeds
from hapticdb.errors import FileError, UsageError
from hapticdb.mesh import SUFFIXES, MeshFile, child, parse_in_process
from hapticdb.mesh.parse import reader_of

FORMATS = (*SUFFIXES, *OTHERS)

SLOWEST = 30.0
"""Seconds after which reading a file counts as a hang."""
BASE_BYTES = 64 << 20
"""Bytes that a file may take beyond ten times its size and the size of its result."""
SOUND = ("read", "refused", "library crashed, in one line")


def _resident() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


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

        Recording(path).poses()


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


def _read(path: Path) -> list[Any]:
    """Result of reading a file, a line that describes it, and the bytes of what was read."""
    try:
        if path.suffix in OTHERS:
            _read_ours(path)
            return ["read", "", 0]
        child._limit_memory(child.allowance(path), None)
        file = parse_in_process(path)
        return [_unsound(file) or "read", "", _size_of(file)]
    except (FileError, UsageError) as error:
        return ["refused" if "\n" not in str(error) else "several lines", str(error), 0]
    except MemoryError:
        return ["refused" if path.suffix in SUFFIXES else "memory", "too much memory", 0]
    except BaseException:  # noqa: BLE001 - what is looked for
        return ["traceback", traceback.format_exc(limit=-2), 0]


def verdict(path: Path) -> tuple[str, str]:
    """The result of reading a file in a fork, and a line that describes it."""
    before, ends = _resident(), os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            signal.setitimer(signal.ITIMER_REAL, SLOWEST)
            for stream in (1, 2):  # libraries write there
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
            os.write(ends[1], json.dumps(_read(path)).encode()[:4000])
        finally:
            os._exit(0)
    os.close(ends[1])
    with os.fdopen(ends[0], "rb") as answer:
        said = answer.read()
    _, status, usage = os.wait4(pid, 0)
    if os.WIFSIGNALED(status):
        if os.WTERMSIG(status) == signal.SIGALRM:
            return "hang", ""
        # an import's child ends like this, too, and its reader says so in one line
        is_told = path.suffix in SUFFIXES
        return "library crashed, in one line" if is_told else "crash", f"killed by {status}"
    found, line, n_result = json.loads(said)
    peak = (usage.ru_maxrss << 10) - before
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
    counts = Counter[str]()
    for n in numbers:
        path.write_bytes(make(n, seed, known))
        found, line = verdict(path)
        counts[found] += 1
        if found not in SOUND or len(numbers) == 1:
            size = path.stat().st_size
            print(f"file {n} ({suffix}, {size} bytes): {found}: {line[-1500:]}", flush=True)
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
