"""Damaged files are read or refused in one line, within bounds of time and memory."""

import faulthandler
import os
import resource
import signal
import sys
import traceback
from pathlib import Path
from random import Random

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from children import finished
from draws import is_every
from file_mutations import mutated
from file_seeds import OTHERS, seeds
from hapticdb import PointShell
from hapticdb.errors import FileError, UsageError
from hapticdb.mesh import SUFFIXES, MeshFile, child, parse_in_process
from hapticdb.mesh.parse import reader_of
from hapticdb.poses import read_timed_poses
from hapticdb.recording.file import Recording

SLOWEST_S = 30
"""Seconds after which reading a file counts as a hang."""
BASE_BYTES = 64 << 20
"""Bytes that a file may take beyond ten times its size and the size of its result."""
MAY_CRASH = {".las", ".laz", ".step", ".stp"}
"""Formats whose library may crash: `read_file` tells it in one line (tests/mesh/test_child)."""


def bytes_of_result(path: Path) -> int:
    """Read a file; the size of its result, which is sound."""
    if path.suffix == ".npz":
        assert np.isfinite(PointShell.load(path).points).all()
    elif path.suffix == ".csv":
        assert np.isfinite(read_timed_poses(path)[1]).all()
    elif path.suffix == ".hdbrec":
        Recording(path).columns("time", "hand", "wrench", until_damage=True)
    else:
        return bytes_of_parts(parse_in_process(path))
    return 0


def bytes_of_parts(file: MeshFile) -> int:
    """Size of the parts of a file, which are finite, not empty and have printable names."""
    for part in file.parts:
        assert np.isfinite(part.bounds).all()
        assert np.isfinite(part.world_from_part).all()
        faces = np.empty(0, dtype=np.int64) if part.faces is None else part.faces
        assert 0 <= faces.min(initial=0) <= faces.max(initial=0) < len(part.vertices)
        assert part.name.isprintable()
    arrays = {id(a): a for part in file.parts for a in (part.vertices, part.faces) if a is not None}
    return sum(a.nbytes for a in arrays.values()) + sum(1000 + len(p.name) for p in file.parts)


def most_held() -> int:
    """Bytes that this process has held at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def fault_of(path: Path) -> str:
    """What is wrong with how a file is read, in this process; empty: nothing."""
    before, n_result = most_held(), 0
    child._limit_memory(child.allowance(path), None)
    try:
        n_result = bytes_of_result(path)
    except (FileError, UsageError) as error:
        if "\n" in str(error):
            return f"several lines: {error}"
    except BaseException:  # noqa: BLE001 - what is looked for
        return traceback.format_exc(limit=-2)
    taken = most_held() - before
    most = BASE_BYTES + 10 * (path.stat().st_size + n_result)
    return f"{taken >> 20} MiB" if taken > most else ""


def fault_in_fork(path: Path) -> str:
    """What is wrong with how a file is read, in a copy of this process that has its libraries."""
    told = path.with_suffix(".told")
    pid = os.fork()
    if not pid:
        try:
            faulthandler.disable()
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(SLOWEST_S)
            silence = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silence, 1)
            os.dup2(silence, 2)
            told.write_text(fault_of(path), errors="replace")
            os._exit(0)
        finally:
            os._exit(1)
    code = os.waitstatus_to_exitcode(os.wait4(pid, 0)[1])  # the alarm ends it
    if code == -signal.SIGALRM:
        return "a hang"
    if code < 0 and path.suffix in MAY_CRASH:
        return ""
    return f"exit code {code}" if code else told.read_text()


def check(suffix: str, folder: Path, most: int) -> None:
    """Read so many damaged files of a format."""
    known = seeds(suffix, folder)
    (folder / "beside.bin").write_bytes(bytes(48))
    path = folder / f"damaged{suffix}"
    if suffix in SUFFIXES:
        reader_of(path)  # loads its libraries

    @settings(max_examples=most, deadline=None, database=None, phases=[Phase.generate])
    @given(seed=st.integers(0, 2**32 - 1))
    def has_no_fault(seed: int) -> None:
        random = Random(seed)  # noqa: S311 - damages, no secrets
        path.write_bytes(mutated(random, suffix, random.choice(known)))
        fault = fault_in_fork(path)
        assert not fault, fault

    has_no_fault()


@pytest.mark.skipif(sys.platform != "linux", reason="memory is counted as Linux counts it")
@pytest.mark.long
@pytest.mark.parametrize("suffix", [*SUFFIXES, *OTHERS])
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path: Path, suffix: str) -> None:
    """Each format has a process of its own, because a fork copies all that is loaded."""
    command = [sys.executable, __file__, suffix, str(tmp_path), "400" if is_every() else "40"]
    paths = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = finished(command, cwd=tmp_path, env=paths)
    assert done.returncode == 0, done.stderr


if __name__ == "__main__":
    check(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))
