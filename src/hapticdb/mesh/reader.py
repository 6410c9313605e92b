"""Files read in a parser process: the parent's side.

The child is started by its path: `multiprocessing` would run the user's main module again. An array
shared by several parts is sent once.
"""

import contextlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import FileError, MissingExtraError, pip_line
from hapticdb.mesh.chord import check_chord
from hapticdb.mesh.clean import read_only
from hapticdb.mesh.parse import READERS, is_tessellated, parse
from hapticdb.mesh.parsed import UnreadableError
from hapticdb.mesh.part import Defects, MeshFile, Part
from hapticdb.mesh.scratch import scratch_folder
from hapticdb.units import metres_of

_EXTRAS = {
    "ifc": ("ifc", ("ifcopenshell",)),
    "las": ("pointcloud", ("laspy", "lazrs")),
    "step": ("step", ("cascadio",)),
}
_CHILD = Path(__file__).with_name("child.py")
_SECONDS = 20.0
_SECONDS_PER_MIB = 5.0
_SECONDS_PER_MIB_OF = {"ifc": 20.0, "step": 20.0, "threemf": 10.0}
"""Limit of a file's processor time, seconds: a base, plus a number for each MiB; at least ten times
the time of sound files. STEP and IFC files are tessellated, and 3MF files unpack to a multiple of
their size. Larger values let a damaged file take longer before it is refused."""
_WAITING = 10.0
"""Wall-clock limit in multiples of the processor time limit, for a parser in an endless wait."""
_LIBRARIES = {
    "step": ("OpenCASCADE", "save it anew as STEP AP214 or AP242, or as glTF or STL"),
    "ifc": ("IfcOpenShell", "save it anew as IFC4, or as glTF"),
    "las": ("lazrs, its decompressor", "unpack it to LAS with another program"),
}
"""Libraries that may crash on a damaged file, by reader: name, and advice for the user."""
_LONGEST_CAUSE = 300
"""Longest cause in a message, characters."""
_MORE_TIME = "if it is sound, give more: import --time-limit, read_file(time_limit=...)"


def read_file(
    path: str | os.PathLike[str],
    *,
    unit: str | None = None,
    memory_limit: int | None = None,
    time_limit: float | None = None,
    chord: float | None = None,
) -> MeshFile:
    """All usable parts of a mesh, CAD or point-cloud file, in metres.

    Parsed in a child process of bounded memory and processor time: no file can crash or hang its
    reader.

    path : its suffix, one of `hapticdb.mesh.SUFFIXES`, selects the format.
    unit : one of `hapticdb.mesh.UNITS`, for a file without a unit of its own, such as OBJ or STL.
        By default that of the reference system of a LAS or LAZ file, or of a comment, else metres.
    memory_limit : bytes for parsing; by default in proportion to the file, see `child.allowance`
    time_limit : seconds of processor time; by default in proportion to the file. A parser that
        waits is ended after ten times as long.
    chord : greatest chord error of the tessellation of a STEP file, 0.00001 m by default, or of an
        IFC file, 0.0001 m; no effect on other files. The resulting one is `Part.chord`.

    Raises `FileError` if the file is missing, damaged, of an unknown kind, or contains no usable
    triangle or point, one line with file and cause; `MissingExtraError` if the format needs an
    extra; `UsageError` if the unit is unknown, or the chord error out of range.
    """
    check_chord(chord)
    metres, file = _checked(path, unit)
    each = _SECONDS_PER_MIB_OF.get(READERS[file.suffix.lower()], _SECONDS_PER_MIB)
    own = _SECONDS + each * file.stat().st_size / (1 << 20)
    seconds = own if time_limit is None else time_limit
    request = {
        "path": str(file), "metres": metres, "chord": chord, "memory_limit": memory_limit,
        "time_limit": seconds, "parent": os.getpid(), "sys_path": sys.path,
    }  # fmt: skip
    try:
        return _run_child(request, seconds)
    except UnreadableError as error:
        is_slow = is_tessellated(file) and _MORE_TIME in str(error)
        cause = f"{error}, or a larger --chord" if is_slow else error
        raise FileError(_one_line(path, cause)) from None


def parse_in_process(
    path: str | os.PathLike[str], *, unit: str | None = None, chord: float | None = None
) -> MeshFile:
    """`read_file` without a child process and without limits, for trusted files."""
    check_chord(chord)
    metres, file = _checked(path, unit)
    try:
        return parse(file, metres, chord)
    except UnreadableError as error:
        raise FileError(_one_line(path, error)) from None


def _checked(path: str | os.PathLike[str], unit: str | None) -> tuple[float | None, Path]:
    """Length of the given unit, and the resolved path; raises all errors that need no parsing."""
    metres = None if unit is None else metres_of(unit)
    file = Path(path)
    try:
        file = file.resolve()
        refusal = _refusal(file)
    except (OSError, ValueError, RuntimeError) as error:
        refusal = (getattr(error, "strerror", None) or str(error)).lower()
    if refusal is not None:
        raise FileError(_one_line(path, refusal))
    extra, modules = _EXTRAS.get(READERS[file.suffix.lower()], ("", ()))
    if any(importlib.util.find_spec(module) is None for module in modules):
        raise MissingExtraError(f"{file.suffix} files need more packages: {pip_line(extra)}")
    return metres, file


def _refusal(file: Path) -> str | None:
    """Reason to refuse a file before parsing; None without one."""
    if file.is_dir():
        return "it is a directory; name the files in it"
    if not file.exists():
        return "there is no such file"
    if not file.is_file():
        return "it is no regular file"
    if file.suffix.lower() not in READERS:
        known = ", ".join(suffix[1:] for suffix in READERS)
        return f"'{file.suffix}' is no known kind of file; known are {known}"
    with file.open("rb") as stream:
        return None if stream.read(1) else "it is empty"


def _one_line(path: str | os.PathLike[str], cause: object) -> str:
    """One printable line of file and cause."""
    words = " ".join(str(cause).split())
    if len(words) > _LONGEST_CAUSE:
        words = words[: _LONGEST_CAUSE - 3] + "..."
    text = f"cannot read {os.fspath(path)}: {words}".encode("utf-8", "backslashreplace").decode()
    return "".join(c if c.isprintable() else " " for c in text)


def _run_child(request: dict[str, Any], seconds: float) -> MeshFile:
    """Run a request in a child process; no child outlives this call."""
    # One arena and one thread: memory reserved per thread would count as the file's.
    settings = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    settings["MALLOC_ARENA_MAX"] = "2"
    with contextlib.ExitStack() as held:
        scratch = held.enter_context(scratch_folder())
        words = held.enter_context(tempfile.TemporaryFile())
        child = held.enter_context(subprocess.Popen(  # noqa: S603 - our own interpreter and file
            [sys.executable, "-P", str(_CHILD)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=words, env=os.environ | settings | {"TMPDIR": scratch},
        ))  # fmt: skip
        late = threading.Event()
        longest = min(_WAITING * seconds, threading.TIMEOUT_MAX)
        timer = threading.Timer(longest, _end, (child, late))
        timer.daemon = True
        timer.start()
        try:
            found = _talk(child, request)
        finally:
            timer.cancel()
            child.kill()
            child.wait()
        if found is None:
            took = f"longer than {seconds:.3g} s of processor time"
            if late.is_set():
                took = f"{longest:.3g} s without an end, most of them waiting"
            if late.is_set() or child.returncode == -signal.SIGPROF:
                raise UnreadableError(f"reading it took {took}; {_MORE_TIME}")
            raise UnreadableError(_why_ended(child.returncode, words, request["path"]))
        return found


def _end(child: subprocess.Popen[bytes], late: threading.Event) -> None:
    late.set()
    child.kill()


def _talk(child: subprocess.Popen[bytes], request: dict[str, Any]) -> MeshFile | None:
    """Send the request and receive the answer; None if the child ended before its answer."""
    assert child.stdin is not None and child.stdout is not None  # noqa: S101, PT018 - pipes
    try:
        child.stdin.write(json.dumps(request).encode())
        child.stdin.close()
        line = child.stdout.readline()
        if line.endswith(b"\n"):
            return _received(json.loads(line), child.stdout, request["path"])
    except (BrokenPipeError, EOFError):
        return None
    child.wait()
    return None


def _received(head: dict[str, Any], stream: IO[bytes], link: str) -> MeshFile:
    """Parts from the header of an answer, and the arrays after it."""
    if "error" in head:
        raise UnreadableError(head["error"])
    worlds = _filled(((len(head["parts"]), 4, 4), "f8"), stream)
    geometries = [
        [None if one is None else _filled(one, stream) for one in arrays]
        for arrays in head["geometries"]
    ]
    shared: list[dict[str, str]] = [{} for _ in geometries]
    parts = []
    for (name, n, found, said), placed in zip(head["parts"], worlds, strict=True):
        vertices, faces, colours = geometries[n]
        shape = (vertices, faces, placed.copy(), Defects(**found), shared[n], colours)
        parts.append(Part(name, *shape, head["chords"][n], said))
    rest = (head["names_unit"], head["up"], tuple(head["notes"]), tuple(head["named"]))
    return MeshFile(link, parts, Defects(**head["defects"]), *rest)


def _filled(described: tuple[tuple[int, ...], str], stream: IO[bytes]) -> NDArray[Any]:
    """Read-only array of a shape and type, from the next bytes of a stream."""
    array = np.empty(*described)
    if stream.readinto(array.reshape(-1).view(np.uint8)) < array.nbytes:  # type: ignore[attr-defined]
        raise EOFError
    return read_only(array)


def _why_ended(returncode: int, words: IO[bytes], path: str) -> str:
    """Reason for the end of a child without an answer."""
    if returncode < 0:
        name = signal.Signals(-returncode).name
        reader = READERS[Path(path).suffix.lower()]
        library, advice = _LIBRARIES.get(reader, ("its parser", "save it anew"))
        return (
            f"it is damaged or cut short, or asks for more memory than a file of its size may use "
            f"({name} of {library}): copy it anew from its source, or {advice}"
        )
    words.seek(0)
    lines = words.read()[-4096:].decode("utf-8", "replace").split("\n")
    last = next((line for line in reversed(lines) if line.strip()), "no word of why")
    return f"its parser ended with status {returncode}: {last}"
