"""Cache of the shells of tool files, in the user's cache folder.

Making the shell of the sample's wrench takes 0.9 s of processor time and a parser process; reading
it from the cache 16 ms, most of them for the digests. The key of an entry is made of the file's
bytes, the request and the versions of the libraries. An entry contains digests of the referenced
files, and is ignored if one of them differs.
"""

import contextlib
import hashlib
import json
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hapticdb.mesh.parse import is_tessellated
from hapticdb.mesh.parsed import referenced_path
from hapticdb.pointshell.shell import DEFAULT_POINTS, PointShell
from hapticdb.user_cache import content_of, entry_of, keep

NUMBERS = 7
"""Numbers of a point in an entry: position, normal, inset."""
CACHED = ("is_closed", "seed", "defects", "chord", "has_unit")
"""Fields of a shell stored unchanged in an entry."""


class Tool(NamedTuple):
    """A tool of a file: its shell, without triangles if cached, and its longest side, m."""

    shell: PointShell
    length: float


def made_tool(path: str, points: int | None, *, unit: str | None, seed: int, inset: float) -> Tool:
    """Tool of a file, without the cache; arguments and errors as for `PointShell.from_file`."""
    shell = PointShell.from_file(path, points, unit=unit, seed=seed, inset=inset)
    return Tool(shell, float(np.ptp(shell.outline, axis=0).max()))


def cached_tool(
    path: str, points: int | None, *, unit: str | None, seed: int, inset: float
) -> Tool:
    """Tool as by `made_tool`, bit for bit, but without triangles if it is from the cache."""
    began = time.time()
    n_points = DEFAULT_POINTS if points is None else points
    entry = _entry(Path(path), (n_points, unit, seed, inset))
    found = None if entry is None else _read(entry, Path(path).resolve())
    if found is None:
        found = made_tool(path, points, unit=unit, seed=seed, inset=inset)
        if entry is not None:
            _write(entry, found, began)
    return found


def _entry(path: Path, request: tuple[object, ...]) -> Path | None:
    """Cache file of a request; None for requests without an entry: a saved shell or no file."""
    suffix = path.suffix.lower()
    if suffix == ".npz" or not path.is_file():
        return None
    libraries = ["numpy", "scipy", "mapbox_earcut"]
    libraries += ["cascadio"] if is_tessellated(path) else []
    with contextlib.suppress(ImportError, RuntimeError):  # an extra is missing; nobody's home
        versions = [version(name) for name in libraries]
        return entry_of("shells", request, suffix, _digest(path), versions, sys.byteorder)
    return None


def _digest(file: Path | None) -> str | None:
    """SHA-256 of a file's bytes; None if unreadable."""
    with contextlib.suppress(OSError):
        if file is not None:
            with file.open("rb") as stream:
                return hashlib.file_digest(stream, "sha256").hexdigest()
    return None


def _read(entry: Path, file: Path) -> Tool | None:
    """Tool of an entry; None without one, or if a referenced file has changed."""
    content = content_of(entry)
    if content is None:
        return None
    line, _, numbers = content.partition(b"\n")
    head: dict[str, Any] = json.loads(line)
    if any(
        _digest(referenced_path(file.parent, name)) != one for name, one in head["named"].items()
    ):
        return None
    rows = np.frombuffer(numbers).reshape(-1, NUMBERS)
    shell = PointShell(
        rows[:, :3], rows[:, 3:6], np.array(head["center"]), link=str(file), inset=rows[:, 6],
        named=tuple(head["named"]), **{name: head[name] for name in CACHED},
    )  # fmt: skip
    return Tool(shell, head["length"])


def _write(entry: Path, tool: Tool, began: float) -> None:
    """Store a tool, unless one of its files was written since `began`."""
    shell = tool.shell
    file = Path(shell.link)
    files = {name: referenced_path(file.parent, name) for name in shell.named}
    head = {name: getattr(shell, name) for name in CACHED} | {
        "center": shell.center.tolist(),
        "length": tool.length,
        "named": {name: _digest(one) for name, one in files.items()},
    }
    rows = np.column_stack([shell.points, shell.normals, shell.inset])
    with contextlib.suppress(OSError):
        if max(one.stat().st_ctime for one in [file, *filter(None, files.values())]) < began:
            keep(entry, json.dumps(head).encode() + b"\n" + rows.tobytes())
