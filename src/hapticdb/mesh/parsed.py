"""Unchecked output of the format readers: shapes, placements, notes; parsing common to formats."""

import re
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.part import Defects
from hapticdb.mesh.text import unit_in

Node = TypeVar("Node", bound=Hashable)

_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_ONE = {"s": "", "es": "", "ies": "y", "are": "is", "begin": "begins", "come": "comes",
        "hold": "holds", "refer": "refers"}  # fmt: skip
"""Plural endings and verbs in messages, and their singular."""
HIDDEN = "node{s} {are} hidden in it, and {come} in like any other"
ANIMATED = "node{s} {are} moved by animations, which are not read"


class UnreadableError(Exception):
    """Cause of an unreadable file, in plain words, without the file's name."""


@dataclass(frozen=True)
class Shape:
    """Geometry as read: indices may be out of range, coordinates may be NaN.

    vertices (V, 3), the file's unit, any number type; faces (F, 3), any integer type, or None for a
    point cloud; defects : pieces dropped by the reader; colours : (F, 4) of triangles or (V, 4) of
    a cloud's points, as in `Part`, or None; normals : (V, 3), or None; chord : chord error, the
    file's unit, 0 for exact triangles.
    """

    vertices: NDArray[np.generic]
    faces: NDArray[np.generic] | None
    defects: Defects = field(default_factory=Defects)
    colours: NDArray[np.uint8] | None = None
    normals: NDArray[np.generic] | None = None
    chord: float = 0.0


@dataclass(frozen=True, slots=True)
class Placement:
    """One instance of a shape: its node path, (4, 4) transform in the file's unit, attributes."""

    name: str
    shape: int
    world_from_part: NDArray[np.float64]
    attributes: dict[str, str] = field(default_factory=dict)


@dataclass
class Parsed:
    """A file's contents before any check.

    metres : length of the file's unit, None without one; likely_metres : length of a suggested
    unit, such as the reference system's, overridden by the option `unit`; up : up axis, None if
    undefined; not_lengths : error message for coordinates without a length unit, such as degrees,
    else None.
    """

    shapes: list[Shape]
    placements: list[Placement]
    metres: float | None = None
    defects: Defects = field(default_factory=Defects)
    likely_metres: float | None = None
    up: str | None = None
    notes: list[str] = field(default_factory=list)
    not_lengths: str | None = None


def require(is_read: bool, what: str) -> None:  # noqa: FBT001 - what is asked
    """Raise UnreadableError unless a required feature, `what`, is supported."""
    if not is_read:
        raise UnreadableError(f"it requires the {what}, which is not read: save it without")


def count_note(n: int, words: str, **named: str) -> list[str]:
    """Note with a count, in the singular for one; empty for zero.

    words : template with the forms of `_ONE` and the keys of `named` in braces.
    """
    forms = _ONE if n == 1 else {many: many for many in _ONE}
    return [f"{n:,} {words.format(**forms, **named)}"] if n > 0 else []


NAMED: set[str] = set()
"""Names of referenced files that this process has searched."""


def referenced_path(folder: Path, name: str) -> Path | None:
    """Path of a referenced file, its name as written or percent-decoded (%20); None if missing."""
    NAMED.add(name)
    for candidate in (name, unquote(name), unquote(name).replace("\\", "/")):
        try:
            if (folder / candidate).is_file():
                return folder / candidate
        except (OSError, ValueError):  # a name too long, or with a null in it
            continue
    return None


def missing_note(folder: Path, names: Iterable[str], *more: str) -> list[str]:
    """Note of missing files with colours or pictures: those absent of `names`, and `more`."""
    plain = (name.removeprefix("file://") for name in names if name[:5] != "data:")
    gone = (name for name in plain if referenced_path(folder, name) is None)
    missing = list(dict.fromkeys([*more, *gone]))
    which = ", ".join(name[-60:] for name in missing[:3])
    words = "file{s} with its colours or pictures {are} not readable beside it: {which}"
    return count_note(len(missing), words, which=which)


def placed_once(
    named: Iterable[tuple[str, Shape]], notes: Sequence[str] = (), comments: str = ""
) -> Parsed:
    """Contents of a file without placements: each shape once; comments may suggest a unit."""
    pairs = list(named)
    placements = [Placement(name, i, np.eye(4)) for i, (name, _) in enumerate(pairs)]
    unit, metres = unit_in(comments)
    said = [*notes, *([] if metres is None else [f"a comment in it names a unit: '{unit}'"])]
    return Parsed([shape for _, shape in pairs], placements, None, likely_metres=metres, notes=said)


def numbers(text: str, dtype: type[np.float64] | type[np.int64]) -> NDArray[np.generic]:
    """Numbers of a text, separated by white space; UnreadableError for any other word."""
    if not text or text.isspace():
        return np.empty(0, dtype=dtype)
    with warnings.catch_warnings():
        # numpy stops at the first word that is not a number, and by default only warns.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, dtype=dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            words = re.findall(r"[^ \t-\r]+", text)  # a no-break space is none to numpy
            word = next((word for word in words if not _is_number(word, dtype)), words[0])
            commas = ": write decimals with points" if _COMMA.fullmatch(word) else ""
            raise UnreadableError(
                f"it holds '{word[:40]}' where a number should be{commas}"
            ) from None


def indices(words: Iterable[str]) -> list[int]:
    """Integers of a face; UnreadableError for any other word."""
    try:
        return [int(word) for word in words]
    except ValueError:
        raise UnreadableError("a face holds a word where an index should be") from None


def positions(lines: Sequence[str]) -> NDArray[np.float64]:
    """Positions (V, 3) in the first three columns of lines; UnreadableError for fewer columns."""
    words = [line.split(None, 3)[:3] for line in lines]
    if any(len(three) < 3 for three in words):
        raise UnreadableError("a vertex has fewer than three coordinates")
    flat = numbers(" ".join(" ".join(three) for three in words), np.float64)
    if flat.size != 3 * len(lines):
        raise UnreadableError("a vertex has fewer than three coordinates")
    return np.asarray(flat, dtype=np.float64).reshape(-1, 3)


def _is_number(word: str, dtype: type[np.float64] | type[np.int64]) -> bool:
    try:
        np.fromstring(word, dtype=dtype, sep=" ")  # Python itself takes '1_0', too
    except (DeprecationWarning, ValueError):
        return False
    return True


def walk(
    roots: Iterable[tuple[Node, NDArray[np.float64]]],
    children: Callable[[Node], Iterable[tuple[Node, NDArray[np.float64]]]],
) -> Iterator[tuple[list[Node], NDArray[np.float64]]]:
    """Depth-first traversal of all placed nodes: path from the root, and world_from_node.

    In the order of the file; a node on two paths is yielded twice. The yielded list is reused, so
    copy it. Iterative: deep nesting takes no stack. UnreadableError for a cycle.
    """
    path: list[Node] = []
    on_path: set[Node] = set()
    levels = [(iter(roots), np.eye(4))]
    while levels:
        step = next(levels[-1][0], None)
        if step is None:
            levels.pop()
            if path:
                on_path.discard(path.pop())
            continue
        node, parent_from_node = step
        if node in on_path:
            raise UnreadableError("one of its nodes is its own ancestor")
        world_from_node = levels[-1][1] @ parent_from_node
        path.append(node)
        on_path.add(node)
        yield path, world_from_node
        levels.append((iter(children(node)), world_from_node))
