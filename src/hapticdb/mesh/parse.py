"""Reader of each format; any failure of a reader becomes one line of plain words."""

import functools
import importlib
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hapticdb.mesh.clean import clean
from hapticdb.mesh.parsed import Parsed, UnreadableError
from hapticdb.mesh.part import MeshFile

READERS = {
    ".3mf": "threemf",
    ".dae": "dae",
    ".glb": "gltf",
    ".gltf": "gltf",
    ".ifc": "ifc",
    ".las": "las",
    ".laz": "las",
    ".obj": "wavefront",
    ".off": "off",
    ".ply": "ply",
    ".step": "step",
    ".stl": "stl",
    ".stp": "step",
}
"""Reader's module in `formats`, by suffix in lower case."""


def is_tessellated(path: str | os.PathLike[str]) -> bool:
    """Whether the triangles of a format approximate CAD surfaces, by the file's suffix."""
    return READERS.get(Path(path).suffix.lower()) in {"ifc", "step"}


def reader_of(path: Path, chord: float | None = None) -> Callable[[Path], Parsed]:
    """Reader of a format; imports the libraries of this format only.

    chord : greatest chord error of a tessellation, metres; None for the format's default.
    """
    module = importlib.import_module(f"hapticdb.mesh.formats.{READERS[path.suffix.lower()]}")
    reader: Callable[..., Parsed] = module.read
    is_wanted = chord is not None and is_tessellated(path)
    return functools.partial(reader, chord=chord) if is_wanted else reader


def parse(path: Path, metres: float | None, chord: float | None = None) -> MeshFile:
    """Sound parts of a file, parsed in this process; any failure is an `UnreadableError`.

    metres : unit length of a file without a unit, or None; chord : as for `reader_of`.
    """
    read = reader_of(path, chord)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # `clean` counts what is not finite
            return clean(read(path), metres, str(path))
    except (UnreadableError, KeyboardInterrupt):
        raise
    except BaseException as error:  # parsers raise errors of every kind; Rust parsers panic
        raise UnreadableError(cause_of(error)) from error


def cause_of(error: BaseException) -> str:
    """Cause of a library's failure, in plain words."""
    detail = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return (
            "reading it takes more memory than a file of its size may use; "
            "if it is sound, give more: import --memory-limit, read_file(memory_limit=...)"
        )
    if "failed to fill whole buffer" in detail:  # lazrs
        return "it is damaged or cut short"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, ImportError):
        return f"its reader cannot be loaded: {detail}"
    if isinstance(error, FileNotFoundError):
        return f"it refers to {error.filename or detail}, which is missing"
    if isinstance(error, (zipfile.BadZipFile, zlib.error)):
        return f"its archive is damaged or cut short ({detail})"
    if isinstance(error, UnicodeError):
        return "it is damaged: its text is not UTF-8"
    if isinstance(error, OSError):
        return f"reading failed: {error.strerror or detail}"
    if isinstance(error, KeyError):
        return f"it is damaged: it refers to {_shown(error)}, which it does not define"
    if isinstance(error, (IndexError, StopIteration, AssertionError, struct.error)):
        return "it is damaged or cut short"
    if isinstance(error, (TypeError, AttributeError)):
        return "it is damaged: something in it is missing or of the wrong kind"
    return f"it is damaged or not supported: {detail or type(error).__name__}"


def _shown(error: KeyError) -> str:
    """Name of a missing key, if printable."""
    key = error.args[0] if error.args else None
    if isinstance(key, str) and key.isprintable() and key.strip():
        return f"'{key}'"
    return str(key) if isinstance(key, int) else "something"
