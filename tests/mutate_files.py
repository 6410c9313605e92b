"""Damages sound files and reads them as an import does: ``python tests/mutate_files.py 50000``.

Each file must be read or be refused in one line: without a traceback or a hang, with at most ten
times the memory of the file and its result, and with sound geometry. The exit code is 1 if a file
broke one of these rules. File number n is the same on every run: ``--only n`` reads it again.

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
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from random import Random

import numpy as np

from children import finished
from file_mutations import mutated
from file_seeds import OTHERS, seeds
from hapticdb.errors import FileError, UsageError
from hapticdb.mesh import SUFFIXES, MeshFile, child, parse_in_process
from hapticdb.mesh.parse import reader_of

FORMATS = (*SUFFIXES, *OTHERS)
SLOWEST, LONGEST = 30.0, 120.0
"""Seconds of processor time, and of a busy machine's clock, after which reading a file hangs."""
HANGS = signal.SIGPROF, signal.SIGALRM
BASE_BYTES = 64 << 20
"""Bytes that a file may take beyond ten times its size and the size of its result."""


def _read_ours(path: Path) -> None:
    from hapticdb import PointShell  # noqa: PLC0415
    from hapticdb.poses import read_timed_poses  # noqa: PLC0415
    from hapticdb.recording.file import Recording  # noqa: PLC0415

    if path.suffix == ".npz":
        assert np.isfinite(PointShell.load(path).points).all(), "points that are not finite"
    elif path.suffix == ".csv":
        assert np.isfinite(read_timed_poses(path)[1]).all(), "poses that are not finite"
    else:
        Recording(path).poses()


def _checked(file: MeshFile) -> int:
    """Bytes of a file's geometry, which is sound."""
    arrays = {}
    for part in file.parts:
        assert np.isfinite(part.bounds).all()
        assert np.isfinite(part.world_from_part).all()
        assert len(part.vertices)
        assert part.name.isprintable()
        if part.faces is not None:
            assert part.faces.min(initial=0) >= 0
            assert part.faces.max(initial=-1) < len(part.vertices)
            arrays[id(part.faces)] = part.faces.nbytes
        arrays[id(part.vertices)] = part.vertices.nbytes
    return sum(arrays.values()) + sum(1000 + len(part.name) for part in file.parts)


def _read(path: Path) -> tuple[str, int]:
    """What is wrong with reading a file, if anything, and the bytes of what was read."""
    try:
        if path.suffix in OTHERS:
            _read_ours(path)
            return "", 0
        child._limit_memory(child.allowance(path), None)
        return "", _checked(parse_in_process(path))
    except (FileError, UsageError) as error:
        return f"several lines: {error}" if "\n" in str(error) else "", 0
    except MemoryError:
        return "" if path.suffix in SUFFIXES else "memory", 0
    except BaseException:  # noqa: BLE001 - what is looked for
        return traceback.format_exc(limit=-2), 0


def fault(path: Path) -> str:
    """What is wrong with reading a file in a fork; empty if it is read or refused."""
    before = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    ends = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            signal.setitimer(signal.ITIMER_PROF, SLOWEST)
            signal.setitimer(signal.ITIMER_REAL, LONGEST)
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
        # an import's child may crash, too, and its reader says so in one line
        is_told = path.suffix in SUFFIXES and os.WTERMSIG(status) not in HANGS
        return "" if is_told else f"killed by {status}"
    found, n_result = json.loads(said)
    peak = (usage.ru_maxrss << 10) - before
    if not found and peak > BASE_BYTES + 10 * (path.stat().st_size + n_result):
        found = f"{peak >> 20} MiB"
    return str(found)


def run(suffix: str, numbers: Sequence[int], folder: Path) -> int:
    """Read damaged files of one format; returns how many broke a rule."""
    known, n_bad = seeds(suffix, folder), 0
    (folder / "beside.bin").write_bytes(bytes(48))
    path = folder / f"mutated{suffix}"
    path.write_bytes(known[0])
    _read_ours(path) if suffix in OTHERS else reader_of(path)
    for n in numbers:
        random = Random(n)  # noqa: S311 - damages, no secrets
        path.write_bytes(mutated(random, suffix, random.choice(known), random.choice(known)))
        found = fault(path)
        if found in {
            f"killed by {one.value}" for one in HANGS
        }:  # a fork may inherit a lock of a library's thread; a real hang repeats
            found = fault(path)
        if found:
            n_bad += 1
            print(f"file {n} ({suffix}, {path.stat().st_size} bytes): {found[-1500:]}")
    return n_bad


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", type=int, nargs="?", default=1000)
    parser.add_argument("--only", type=int, help="number of one file to make and read again")
    parser.add_argument("--format", type=int, help="number of one format to run")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    n_format = given.format if given.only is None else given.only % len(FORMATS)
    if n_format is not None:
        numbers = range(n_format, given.files, len(FORMATS)) if given.only is None else [given.only]
        with tempfile.TemporaryDirectory(prefix="hapticdb-mutated-") as folder:
            return int(run(FORMATS[n_format], numbers, Path(folder)) > 0)
    limit = 60 + LONGEST * given.files  # for a run that hangs
    is_bad = False
    for n in range(len(FORMATS)):
        command = [sys.executable, __file__, str(given.files), f"--format={n}"]
        ended = finished(command, stderr=None, timeout=limit)
        print(ended.stdout, end="", flush=True)
        is_bad |= ended.returncode != 0
    print(f"{given.files:,} files")
    return int(is_bad)


if __name__ == "__main__":
    sys.exit(main())
