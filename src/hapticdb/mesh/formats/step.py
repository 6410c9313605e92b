"""STEP through cascadio (OpenCASCADE): tessellated to GLB, in metres, with names."""

import re
from dataclasses import replace
from pathlib import Path

import cascadio
import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.chord import DEFAULT, MARGIN, coarser_note, measured
from hapticdb.mesh.formats import gltf
from hapticdb.mesh.parsed import Parsed, Placement, UnreadableError, count_note
from hapticdb.mesh.text import text_of
from hapticdb.units import UNITS

_POINT = re.compile(r"(CARTESIAN_POINT\s*\(\s*(?:'(?:[^']|'')*'|\$)\s*,\s*\()([^()]*)(?=\))")
_WORDS = re.compile(r"('(?:[^']++|'')*+')|/\*.*?(?:\*/|\Z)", re.DOTALL)
"""A string, group 1, or a comment: each may contain the other's delimiters."""
_LONGEST = 8_000
"""Longest string, characters with its quotes: OpenCASCADE refuses longer words."""
_END = "END-ISO-10303-21"
_NO_END = f"it seems cut short: '{_END}' does not stand at its end"
_FINE = 1e-5
"""Step between 32-bit positions that does no harm, as a share of the extent."""


def read(path: Path, chord: float = DEFAULT) -> Parsed:
    """Parts of a STEP assembly: the surface of each solid as triangles, with its chord error.

    chord : greatest chord error, metres.
    """
    cut: list[int] = []

    def short(found: re.Match[str]) -> str:
        """Truncate a long string; replace a comment by a blank."""
        word = found[1] or " "
        if len(word) <= _LONGEST:
            return word
        cut.append(len(word))
        kept = word[1 : _LONGEST - 1].rstrip("'")  # no half of a doubled quote
        return f"'{kept}'"

    text = _WORDS.sub(short, text_of(path.read_bytes()))
    if "ISO-10303-21" not in text[:1024]:
        raise UnreadableError("it is no STEP file: 'ISO-10303-21' does not stand at its start")
    found = _tessellated(text, path, chord)
    found = _nearer(found, text, path, chord) if _is_coarse(found) else found
    shapes = [measured(shape, chord) for shape in found.shapes]
    others = len(re.findall(r"\bDOCUMENT_FILE\s*\(", text))
    notes = count_note(others, "other file{s} {are} named in it, and {are} not read")
    notes += count_note(len(cut), f"string{{s}} of more than {_LONGEST:,} characters {{are}} cut")
    notes += [] if _END in text else [_NO_END]
    return replace(found, shapes=shapes, notes=[*found.notes, *notes, *coarser_note(shapes, chord)])


def _tessellated(text: str, path: Path, chord: float) -> Parsed:
    """Tessellate a file's text.

    The tolerance is in millimetres, whatever the file's unit (measured in inches, metres, microns
    with cascadio 0.1.1). The default angular tolerance, half a radian, only refines.
    """
    glb = cascadio.load(text.encode(), "step", tol_linear=1e3 * chord / MARGIN)
    if not glb:
        cause = "OpenCASCADE finds nothing in it that it can tessellate"
        raise UnreadableError(cause if _END in text else f"{cause}; {_NO_END}")
    # The solids keep their axes, whatever they mean.
    return replace(gltf.parsed(glb, path.with_suffix(".glb"), normals=True), up=None)


def _is_coarse(found: Parsed) -> bool:
    """Whether a shape is so far from its origin that cascadio's 32-bit positions round it."""
    for shape in found.shapes:
        if len(shape.vertices):
            low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
            farthest = max(-low.min(), high.max())
            if np.spacing(np.float32(farthest)) > _FINE * (high - low).max():
                return True
    return False


def _nearer(found: Parsed, text: str, path: Path, chord: float) -> Parsed:
    """Tessellate anew around the median of the file's points, then move the result back.

    The median is subtracted from all far points. That shifts all solids by the same vector, unless
    an assembly brings far ones near; so the result is compared with the first tessellation.
    """
    points = [_numbers(match[2]) for match in _POINT.finditer(text)]
    middle = np.median([point for point in points if len(point) == 3] or np.zeros((1, 3)), axis=0)

    def moved(match: re.Match[str]) -> str:
        point = _numbers(match[2])
        if len(point) != 3 or np.linalg.norm(point - middle) > np.linalg.norm(point):
            return match[0]
        return match[1] + ",".join(map(repr, (point - middle).tolist()))

    near = _tessellated(_POINT.sub(moved, text), path, chord)
    before, after = _corners(found), _corners(near)
    step = np.spacing(np.float32(np.abs(before).max()))
    along = np.abs(middle).argmax()
    length = (before - after)[0, along] / middle[along] if middle[along] else 0.0
    metres = next((unit for unit in UNITS.values() if abs(length - unit) <= 1e-5 * unit), 0.0)
    if before.shape != after.shape or np.abs(before - after - metres * middle).max() > 4 * step:
        return found  # `clean` reports the loss
    offset = np.eye(4)
    offset[:3, 3] = metres * middle
    placements = [
        Placement(one.name, one.shape, offset @ one.world_from_part) for one in near.placements
    ]
    return replace(near, placements=placements)


def _numbers(text: str) -> NDArray[np.float64]:
    return np.array([float(word) for word in text.split(",")])


def _corners(found: Parsed) -> NDArray[np.float64]:
    """Least and greatest position of each placed shape, in successive rows."""
    corners = []
    for one in found.placements:
        vertices = np.asarray(found.shapes[one.shape].vertices, dtype=np.float64)
        placed = vertices @ one.world_from_part[:3, :3].T + one.world_from_part[:3, 3]
        corners += [placed.min(axis=0), placed.max(axis=0)]
    return np.array(corners)
