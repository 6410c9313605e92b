"""Compile entries before their first call, side by side in several processes.

numba compiles one function at a time in a process, with any number of threads. Each process
compiles whole entries, because two processes that wrote the index of one entry would lose each
other's work, and mostly whole modules, which share leaves. The machine code goes into the cache on
disk; the process that asked, and every later process, loads it from there. A mark file beside the
code says that an entry is compiled for this copy of the package, so that numba need not be loaded
to find out.
"""

import contextlib
import functools
import gc
import hashlib
import importlib
import os
import re
import select
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from fnmatch import fnmatchcase
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from hapticdb.kernels._cache import CACHE_FOLDER, IN_WORKER, sources_digest

LONGEST = (
    *("period.loop", "surfaces.distances", "surfaces.voxelize"),
    *("resident.nearest", "resident.first_hits", "resident.feeling"),
    *("query.refining", "query.contact"),
)
"""Modules of entries that take longest to compile, which come first."""
ENTRY = re.compile(r"^@entry\((.*?)^def (\w+)", re.MULTILINE | re.DOTALL)
"""An entry's declaration in a source: its signature and its name."""


def _names() -> tuple[str, ...]:
    """Entries, by their modules' sources: nobody loads numba to check for compiled ones."""
    folder, found = Path(__file__).parent, {module: list[str]() for module in LONGEST}
    for source in sorted(folder.rglob("[a-z]*.py")):
        module = ".".join(source.relative_to(folder).with_suffix("").parts)
        for signature, name in ENTRY.findall(source.read_text()):
            found.setdefault(module, []).append(f"{module}.{name}")
            if "also=" in signature:
                found[module].append(f"{module}.{name}@distances")
    return tuple(chain.from_iterable(found.values()))


NAMES = _names()
"""Entries of each module, also by their names for the distance law (`_jit.SIGNATURES`)."""
TOGETHER = {
    "resident.feeling": "period.loop.feel",
    "period.loop.move_directly": "period.loop.run",
    "triangles.sweeping": "triangles.nearest",
}
"""Modules, or entries of `APART`, that are compiled after others, if these are compiled, too, in
the same process: they share leaves."""
APART = "period.loop"
"""A module whose entries are jobs of their own: the first session waits for them."""
LONGEST_S = 600.0
"""Seconds without a compiled job after which all processes are ended. What they have not compiled
is compiled where it is first called."""
SERVE = "from hapticdb.kernels.compiling import serve; serve()"
"""Python code that a compiling process runs."""

_SHELL = ("surfaces.sampling.*", "surfaces.sides.*", "curves.encode_kernel")
_VOXELIZE = (
    "surfaces.voxelize.*",
    "surfaces.distances.*",
    "curves.encode_kernel",
    "field.packing.pack_kernel",
)
_RANGES = ("curves.encode_kernel", "surfaces.bricks.brick_voxels_kernel")
_LOCATE = "query.contact.locate"
_COST = (
    _LOCATE,
    "query.contact.spans_of_keys",
    "query.refining.wrench_of_addresses",
    "query.grouping.gap_rows",
    "query.grouping.group_by_gap",
    "query.grouping.group_by_cost",
    "curves.*",
)
_RESIDENT = (
    "resident.cell_table.*",
    "resident.near_voxels.*",
    "field.packing.unpack_kernel",
    *_COST,
)
_FRAMES = "resident.feeling.feel_kernel"
_COUPLING = ("period.loop.run", "period.loop.move_by_coupling")
_DIRECT = ("period.loop.run", "period.loop.move_directly")
PURPOSES: dict[str, tuple[str, ...]] = {
    "import": _VOXELIZE,
    "points": ("curves.encode_kernel",),
    "move": (*_VOXELIZE, *_RANGES),
    "demo": (
        *_VOXELIZE,
        *_SHELL,
        *_COST,
        "query.refining.refine",
        "query.refining.pairs_of_points",
    ),
    "copy": ("surfaces.bricks.*", "curves.*", "query.grouping.gap_rows", *_RANGES),
    "shell": _SHELL,
    "calibrate": _COST,
    "touch": (_LOCATE, "query.refining.refine"),
    "touch by distance": (
        _LOCATE,
        "query.refining.refine@distances",
        "query.refining.asked_rows",
        "field.packing.unpack_kernel",
    ),
    "pairs": ("query.refining.pairs_of_points",),
    "pairs by distance": ("query.refining.pairs_of_points@distances",),
    "statement": (_LOCATE, "query.refining.wrench_of_addresses"),
    "resident": _RESIDENT,
    "feel": (*_SHELL, *_RESIDENT, "hand.handle.*", "motion.*", "rigid.*"),
    "coupling": _COUPLING,
    "direct": (*_DIRECT, "period.loop.feel"),
    "direct by distance": (*_DIRECT, "period.loop.feel@distances"),
    "host": (*_RESIDENT, *_COUPLING),
    "frames": (*_RESIDENT, _FRAMES),
    "frames by distance": (*_RESIDENT, _FRAMES + "@distances"),
    "clashes": ("surfaces.sides.*", "triangles.*", "curves.encode_kernel"),
    "sweep": (*_SHELL, "triangles.*", *_RANGES),
    "extract": (
        *_SHELL,
        *_RESIDENT,
        _FRAMES,
        "resident.first_hits.*",
        "triangles.*",
        *_RANGES,
        "query.contact.*",
        "query.refining.*",
    ),
    "everything": ("*",),
}
"""Entries that each purpose calls; ``*`` is any name (checked by `tests/house/test_warm.py`)."""


class Compiled(NamedTuple):
    """Progress: number of entries that are compiled, and of all entries to compile."""

    done: int
    total: int


def entries_for(*purposes: str) -> list[str]:
    """Entries that those purposes call, each once."""
    patterns = [pattern for purpose in purposes for pattern in PURPOSES[purpose]]
    return [n for n in NAMES if any(fnmatchcase(n, pattern) for pattern in patterns)]


def missing(names: Collection[str]) -> list[str]:
    """Which of those entries this machine's cache does not have."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}:
        return []
    return [name for name in names if not _mark_of(name).exists()]


def compile_missing(
    names: Collection[str],
    progress: Callable[[Compiled], None] | None = None,
    jobs: int | None = None,
) -> int:
    """Compile those entries that the cache does not have, and return how many they were.

    Parameters
    ----------
    names : collection of str
        Entries, as `NAMES` has them.
    progress : callable or None
        Called from this thread, at the start and after each entry.
    jobs : int or None
        Processes side by side; one a processor unless given.
    """
    wanted = missing(names)
    if not wanted:
        return 0
    total, done = len(wanted), 0
    queue = jobs_of(wanted)
    tell = progress or (lambda _: None)
    tell(Compiled(0, total))
    with _workers(queue, min(jobs or os.cpu_count() or 1, len(queue))) as told:
        for name in wanted:  # meanwhile: this process will call them
            _module_of(name)
        news = select.poll()  # `select.select` knows no descriptor above 1,023
        news.register(told, select.POLLIN)
        while news.poll(1000 * LONGEST_S) and (ended := os.read(told, 1)):
            done += len(queue[ended[0]])
            tell(Compiled(done, total))
    if done < total:
        tell(Compiled(total, total))
    return total


def load(names: Collection[str]) -> None:
    """Load those entries from the cache, or compile them here, so that no first call waits."""
    for name in names:
        _compile_here(name)


def jobs_of(names: Collection[str]) -> list[tuple[str, ...]]:
    """Names by job: a module's entries and those of its partner in `TOGETHER` are one job."""
    jobs: dict[str, list[str]] = {}
    parts = {_part_of(name) for name in names}
    for name in sorted(names, key=NAMES.index):
        part = _part_of(name)
        partner = TOGETHER.get(part)
        jobs.setdefault(partner if partner in parts else part, []).append(name)
    return list(map(tuple, jobs.values()))


def _part_of(name: str) -> str:
    """What is compiled in one process: an entry's module, or the entry alone in `APART`."""
    module = name.rpartition(".")[0]
    return name.partition("@")[0] if module == APART else module


@contextlib.contextmanager
def _workers(queue: Sequence[tuple[str, ...]], count: int) -> Iterator[int]:
    """Start processes that compile the jobs of a queue, and end them, even compiling ones.

    They take the numbers of jobs, a byte each, from one pipe, and write a number into another pipe,
    whose end for reading this gives, when the job is done. That pipe ends with the processes. No
    half-written file stays (numba renames).
    """
    asked, ask = os.pipe()
    told, tell = os.pipe()
    os.write(ask, bytes(range(len(queue))))
    os.close(ask)
    # the package is found in the same place as here, in any working folder
    path = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    workers: list[subprocess.Popen[bytes]] = []
    try:
        try:
            with contextlib.suppress(OSError):  # then the first calls compile
                for _ in range(count):
                    worker = subprocess.Popen(  # noqa: S603 - this interpreter, this package
                        [sys.executable, "-c", SERVE, *map(" ".join, queue)],
                        stdin=asked,
                        stdout=tell,
                        stderr=subprocess.DEVNULL,
                        env=os.environ | {IN_WORKER: "1", "PYTHONPATH": path},
                        start_new_session=True,  # the parent handles Ctrl-C and ends this process
                    )
                    workers.append(worker)
        finally:
            os.close(tell)
        yield told
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()
        os.close(asked)
        os.close(told)


def serve() -> None:
    """Run a compiling process, whose arguments are the jobs; see `_workers`."""
    gc.set_threshold(1_000_000, 50, 100)  # compiling makes many objects and few cycles
    while number := os.read(0, 1):
        for name in sys.argv[1 + number[0]].split():
            _compile_here(name)
        os.write(1, number)


def _module_of(name: str) -> ModuleType:
    """Module of an entry, loaded."""
    return importlib.import_module(f"hapticdb.kernels.{name.rpartition('.')[0]}")


def _compile_here(name: str) -> None:
    """Compile an entry in this process, or load it, and mark it as compiled."""
    compiled = getattr(_module_of(name), name.rpartition(".")[2].partition("@")[0])
    if not hasattr(compiled, "compile"):
        return  # the JIT is off
    compiled.compile(importlib.import_module("hapticdb.kernels._jit").SIGNATURES[name])
    mark = _mark_of(name)
    if not mark.exists():
        with contextlib.suppress(OSError):
            mark.touch()


@functools.cache
def _target() -> str:
    """Digest of numba's version and the processor: cached code depends on them, too."""
    from llvmlite import binding  # noqa: PLC0415 - where it is not needed, nobody waits for it

    features = binding.get_host_cpu_features().flatten()
    words = (
        version("numba"), sys.implementation.cache_tag, binding.get_host_cpu_name(), features,
        os.environ.get("NUMBA_CPU_NAME", ""), os.environ.get("NUMBA_CPU_FEATURES", ""),
    )  # fmt: skip
    return hashlib.sha256("\0".join(map(str, words)).encode()).hexdigest()[:16]


def build() -> str:
    """Digests of the kernels' sources, and of compiler and processor: equal ones, equal bits."""
    return f"{sources_digest(Path(__file__).parent)}-{_target()}"


def _mark_of(name: str) -> Path:
    """Mark file of an entry, as it was compiled for this copy of the package.

    Copies of the package with equal sources share the folder, but not the code in it: numba keeps
    code by the path of its source file, and drops it when that file has another time.
    """
    source = Path(__file__).parent.joinpath(*name.split(".")[:-1]).with_suffix(".py").absolute()
    known = source.stat()
    words = f"{source}\0{known.st_mtime_ns}\0{known.st_size}"
    copy = hashlib.sha256(words.encode()).hexdigest()[:16]
    return Path(CACHE_FOLDER) / f"{name}.{_target()}.{copy}.compiled"
