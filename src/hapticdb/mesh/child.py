"""Parser process: reads one file within limits of memory and processor time, and returns arrays.

Run by its path, with a request on standard input (see `reader.py`) and the answer on standard
output. Excess memory, a crash or a hang of a parser ends this process only.
"""

# The package's own __init__ may import modules that parsing does not need. An empty package with
# the same name and path takes its place in this process.
import sys
import types
from pathlib import Path

if __name__ == "__main__":
    _package = types.ModuleType("hapticdb")
    _package.__path__ = [str(Path(__file__).parent.parent)]
    sys.modules["hapticdb"] = _package

import contextlib
import ctypes
import json
import os
import resource
import signal
from typing import Any, BinaryIO

_PR_SET_PDEATHSIG = 1

BASE_BYTES = 512 << 20
BYTES_PER_BYTE = 64
BYTES_PER_PACKED_BYTE = 500
"""Memory limit of a file, bytes: a base, plus a factor times its size, larger for packed formats.
Larger values let a damaged file take more memory before it is refused.

Measured at a mesh of 327,680 triangles, bytes of resident memory per byte of the file: OBJ 12, OFF
12, PLY 11 (text 15), STL 7 (text 5), GLB 12, 3MF 10, DAE 5; LAZ 21, and 101 if all points differ
only in their positions; STEP 114 (0.2 MB).
"""
_PACKED = {".3mf", ".ifc", ".laz", ".step", ".stp"}


def main() -> None:
    """Serve one request, then exit."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and ends this process
    # parsers in other languages may abort on a damaged file
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    request = json.loads(sys.stdin.buffer.read())
    if sys.platform == "linux":  # end with the parent; elsewhere the time limit applies
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != request["parent"]:
        os._exit(1)
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of libraries must not mix with the arrays
    sys.path[:] = request["sys_path"]
    _answer(answer, Path(request["path"]), request)
    answer.flush()
    os._exit(0)  # freeing a large parser's memory would take longer


def _answer(out: BinaryIO, path: Path, request: dict[str, Any]) -> None:
    """Parse, and write a JSON header, the placements, then the arrays."""
    import numpy as np  # noqa: PLC0415 - after sys.path

    from hapticdb.mesh.formats.gltf import bytes_beside  # noqa: PLC0415
    from hapticdb.mesh.parse import cause_of, parse, reader_of  # noqa: PLC0415
    from hapticdb.mesh.parsed import NAMED, UnreadableError  # noqa: PLC0415

    before = None
    try:
        reader_of(path)  # before the limit, so that its libraries do not count as the file's memory
        np.linalg.det(np.eye(3))  # OpenBLAS allocates its buffers now, before the limit
        before = _limit_memory(allowance(path), request["memory_limit"])
        # Counts all threads; its signal ends this process, also if the parent is gone.
        signal.setitimer(signal.ITIMER_PROF, request["time_limit"])
        if path.suffix.lower() == ".gltf" and request["memory_limit"] is None:
            # The files that it refers to are listed under the limit of this file alone.
            _limit_memory(allowance(path, bytes_beside(path)), None)
        file = parse(path, request["metres"], request["chord"])
    except (UnreadableError, MemoryError, ImportError) as error:
        if before is not None:
            resource.setrlimit(_memory_kind(), before)
        cause = str(error) if isinstance(error, UnreadableError) else cause_of(error)
        out.write(json.dumps({"error": cause}).encode() + b"\n")
        return
    first = {id(part.shared): part for part in file.parts}  # one for each geometry
    number = {key: n for n, key in enumerate(first)}
    geometries = [(part.vertices, part.faces, part.colours) for part in first.values()]
    head = {
        "geometries": [
            [None if a is None else (a.shape, a.dtype.str) for a in arrays] for arrays in geometries
        ],
        "chords": [part.chord for part in first.values()],
        "parts": [
            [one.name, number[id(one.shared)], vars(one.defects), one.attributes]
            for one in file.parts
        ],
        "defects": vars(file.defects),
        "names_unit": file.names_unit,
        "up": file.up,
        "notes": file.notes,
        "named": sorted(NAMED),
    }
    out.write(json.dumps(head).encode() + b"\n")
    out.write(np.array([part.world_from_part for part in file.parts]).data)
    there = (array for arrays in geometries for array in arrays if array is not None)
    out.writelines(array.data if array.flags.c_contiguous else array.tobytes() for array in there)


def _memory_kind() -> int:
    """Kind of limit: on Linux data, without reserved address space; elsewhere address space."""
    return resource.RLIMIT_DATA if sys.platform == "linux" else resource.RLIMIT_AS


def _bytes_in(file: str, key: str, otherwise: int) -> int:
    """Bytes under a key of a file of Linux's /proc; `otherwise` if there is none."""
    with contextlib.suppress(OSError):
        for line in Path(file).read_text().splitlines():
            if line.startswith(key):
                return int(line.split()[1]) << 10
    return otherwise


def bytes_available() -> int:
    """Memory available without swapping, bytes; 2^62 if unknown."""
    return _bytes_in("/proc/meminfo", "MemAvailable:", 1 << 62)


def allowance(path: Path, n_beside: int = 0) -> int:
    """Memory limit of parsing, bytes: by the file's size, at most 3/4 of the available memory.

    n_beside : bytes of referenced files.
    """
    n_bytes = path.stat().st_size + n_beside
    factor = BYTES_PER_PACKED_BYTE if path.suffix.lower() in _PACKED else BYTES_PER_BYTE
    return min(BASE_BYTES + factor * n_bytes, bytes_available() * 3 // 4)


def _limit_memory(allowed: int, limit: int | None) -> tuple[int, int]:
    """Limit memory to its present use plus `limit`, or else `allowed`; returns the former limit."""
    kind = _memory_kind()
    before = resource.getrlimit(kind)
    held = _bytes_in("/proc/self/status", "VmData:", 0)  # counted as the limit counts it
    wanted = held + (allowed if limit is None else limit)
    hard = before[1]
    resource.setrlimit(kind, (wanted if hard < 0 else min(wanted, hard), hard))
    return before


if __name__ == "__main__":
    main()
