"""Parallel compilation of all entries of a group into a set (`_machine_code`).

numba compiles one function at a time in a process, with any number of threads. So worker processes
take whole modules from a queue: the entries of a module share leaves.
"""

import fcntl
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from hapticdb.kernels._machine_code import (
    BUILDING,
    built_for,
    digest_of,
    group_of,
    level,
    manifest_of,
)

LONGEST = (
    *("period.loop", "query.refining", "resident.cell_frames"),
    *("triangles.surface_distance", "surfaces.distances", "triangles.path_distance"),
)
"""Modules with the longest compilation, first in the queue: 13 s to 2 s of 50."""
TIMEOUT = 1200.0
"""Time limit of compiling processes, seconds. Larger: slower machines finish."""
MOST_SETS = 30
"""Most sets in a folder, 2 MB each; older ones are removed."""
SERVE = "from hapticdb.kernels._building import serve; serve()"
"""Python code of a compiling process."""


def build_set(folder: Path, group: str) -> None:
    """Compile all entries of a group into a folder, created atomically.

    Raises OSError if compilation fails. A concurrent process waits at a file lock.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_name(f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if manifest_of(folder).get("for") == built_for():
            return
        made = Path(tempfile.mkdtemp(prefix=folder.name, dir=folder.parent))
        try:
            _compile_into(made, group)
            entries = {file.name: digest_of(file.read_bytes()) for file in made.iterdir()}
            manifest = json.dumps({"for": built_for(), "entries": entries}, indent=1)
            (made / "manifest.json").write_text(manifest)
            shutil.rmtree(folder, ignore_errors=True)
            made.rename(folder)
        finally:
            shutil.rmtree(made, ignore_errors=True)
        sets = sorted(folder.parent.glob("kernels-*[!k]"), key=lambda one: one.stat().st_mtime)
        for old in sets[:-MOST_SETS]:
            shutil.rmtree(old, ignore_errors=True)


def _modules(group: str) -> list[str]:
    """Modules with entries of a group, those of `LONGEST` first."""
    folder = Path(__file__).parent
    found = {
        ".".join(source.relative_to(folder).with_suffix("").parts)
        for source in folder.rglob("[a-z]*.py")
        if re.search(r"^@entry\(", source.read_text(), re.MULTILINE)
    }
    ordered = [*LONGEST, *sorted(found.difference(LONGEST))]
    return [module for module in ordered if group_of(module) == group]


def _compile_into(folder: Path, group: str) -> None:
    """Compile all entries of a group, one process a processor; OSError if one fails.

    Their queue is a pipe of module numbers, a byte each.
    """
    modules, known = _modules(group), level()
    queue, feed = os.pipe()
    os.write(feed, bytes(range(len(modules))))
    os.close(feed)
    env = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    env |= {
        BUILDING: str(folder),
        "NUMBA_CPU_NAME": known.cpu,
        "NUMBA_CPU_FEATURES": known.features,
    }
    # same package as here, in any working folder
    env["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    workers: list[subprocess.Popen[bytes]] = []
    until = time.monotonic() + TIMEOUT
    try:
        for _ in range(os.cpu_count() or 1):
            worker = subprocess.Popen(  # noqa: S603 - this interpreter, this package
                [sys.executable, "-c", SERVE, str(os.getpid()), *modules],
                stdin=queue,
                stdout=subprocess.DEVNULL,
                env=env,
                start_new_session=True,  # the parent handles Ctrl-C and ends this process
            )
            workers.append(worker)
        if any(worker.wait(until - time.monotonic()) for worker in workers):
            raise OSError("a process that compiles has failed: its errors are above")
    except subprocess.TimeoutExpired as error:
        raise OSError(f"compiling was not done after {TIMEOUT:g} s") from error
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()
        os.close(queue)


def serve() -> None:
    """Run a compiling process; its arguments are its parent's pid and the modules."""
    parent = int(sys.argv[1])
    while (number := os.read(0, 1)) and os.getppid() == parent:
        module = sys.argv[2 + number[0]]
        importlib.import_module(f"hapticdb.kernels.{module}")
        importlib.import_module("hapticdb.kernels._jit").load_entries(module)
