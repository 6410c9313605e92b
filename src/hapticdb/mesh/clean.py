"""Validation of a reader's output: drops and counts unsound geometry, converts to metres."""

import unicodedata
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.mesh.parsed import Parsed, Placement, Shape, UnreadableError, count_note
from hapticdb.mesh.part import Defects, MeshFile, Part
from hapticdb.units import length_text

Scalar = TypeVar("Scalar", bound=np.generic)

_FLAT = 1e-12
"""Degenerate triangle: twice its area is at most this times its longest edge squared. Rounding
errors of float64 edges are smaller. A larger value also counts thin triangles."""

_COARSE = 1e-3
"""Share of a part's extent above which the step between 32-bit coordinates is reported."""


def clean(parsed: Parsed, metres: float | None, link: str) -> MeshFile:
    """Sound parts of the file `link`, in metres; other geometry is dropped and counted.

    metres : unit length of a file without a unit, or None. UnreadableError without usable geometry,
    or for an invalid unit or transform.
    """
    if parsed.not_lengths is not None and metres is None:
        raise UnreadableError(parsed.not_lengths)
    lengths = (parsed.metres, metres, parsed.likely_metres)
    scale = next((length for length in lengths if length is not None), 1.0)
    if not (np.isfinite(scale) and scale > 0):
        raise UnreadableError(f"its unit of length is {scale} metres")
    checked = [_checked(shape, scale) for shape in parsed.shapes]
    shared: list[dict[str, str]] = [{} for _ in checked]
    parts: list[Part] = []
    total = parsed.defects
    taken: dict[str, int] = {}
    worlds, is_near = _worlds(parsed.placements, [one[0] for one in checked], scale)
    linear = worlds[:, :3, :3]
    sizes = np.sqrt(np.einsum("pij,pij->p", linear, linear))
    # singular up to rounding: triangles may lose their areas
    is_flat = np.abs(np.linalg.det(linear)) <= 1e-9 * sizes**3
    for n, placement in enumerate(parsed.placements):
        vertices, faces, defects, colours = checked[placement.shape]
        n_found = len(vertices if faces is None else faces)
        if n_found and is_near[n]:
            if faces is not None and is_flat[n]:
                flattened = _count_degenerate(vertices, faces, worlds[n, :3, :3])
                defects = replace(defects, degenerate=flattened)
            name = _unique(_printable(placement.name), taken)
            known = shared[placement.shape]
            chord = parsed.shapes[placement.shape].chord * scale
            said = {key: _printable(value) for key, value in placement.attributes.items()}
            shape = (vertices, faces, worlds[n], defects, known, colours, chord)
            parts.append(Part(name, *shape, said))
            if defects:
                total += defects
        elif n_found:
            total += replace(defects, degenerate=0, non_finite=defects.non_finite + n_found)
        else:
            total += defects or Defects(empty=1)
    if not parts:
        found = ", ".join(filter(None, [total.describe(), *map(_printable, parsed.notes)]))
        raise UnreadableError(
            f"it holds no usable triangle or point ({found})" if found else "it holds no triangles"
        )
    names_unit = not (parsed.metres is None and parsed.likely_metres is None)
    notes = [_printable(note) for note in [*parsed.notes, *_coarse(parsed, scale)]]
    if None not in {metres, parsed.metres} and metres != parsed.metres:
        notes.append("it has a unit of its own: the one that was given does not apply")
    return MeshFile(link, parts, total, names_unit, parsed.up, tuple(notes))


def _coarse(parsed: Parsed, scale: float) -> list[str]:
    """Notes of parts too far from the origin for 32-bit coordinates."""
    found = []
    for placement in {p.shape: p for p in reversed(parsed.placements)}.values():
        vertices = parsed.shapes[placement.shape].vertices
        if vertices.dtype != np.float32 or not len(vertices):
            continue
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        farthest = max(-low.min(), high.max())
        step = float(np.spacing(np.float32(farthest)))
        if step > _COARSE * float((high - low).max()):
            found.append(
                f"'{placement.name}' lies {length_text(farthest * scale)} from the origin, where "
                f"its 32-bit numbers are {length_text(step * scale)} apart: details are lost"
            )
    return found[:1] + count_note(len(found) - 1, "more part{s}, likewise")


def _checked(
    shape: Shape, scale: float
) -> tuple[NDArray[np.float64], NDArray[np.int64] | None, Defects, NDArray[np.uint8] | None]:
    """Sound vertices in metres and faces of a shape, read-only; its defects; its colours."""
    vertices = np.asarray(shape.vertices)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise UnreadableError("its vertices do not have three coordinates each")
    if shape.faces is None:
        points = _metric(vertices, scale)
        finite = np.isfinite(points).all(axis=1)
        lost = Defects(non_finite=int((~finite).sum()))
        colours = _of_sound(shape.colours, finite)
        return read_only(points[finite]), None, shape.defects + lost, colours
    faces = np.asarray(shape.faces).astype(np.int64, copy=False).reshape(-1, 3)
    inside = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    out_of_range = len(faces) - int(inside.sum())
    colours = _of_sound(shape.colours, inside)
    vertices, faces = _compact(vertices, faces[inside] if out_of_range else faces)
    positions = _metric(vertices, scale)
    finite = np.asarray(np.isfinite(positions).all(axis=1))
    sound = finite[faces].all(axis=1)
    non_finite = len(faces) - int(sound.sum())
    if non_finite:
        positions, faces = _compact(positions, faces[sound])
        colours = _of_sound(colours, sound)
    degenerate = _count_degenerate(positions, faces, np.eye(3))
    lost = Defects(degenerate=degenerate, non_finite=non_finite, out_of_range=out_of_range)
    return read_only(positions), read_only(faces), shape.defects + lost, colours


def _of_sound(colours: NDArray[np.uint8] | None, is_sound: ArrayLike) -> NDArray[np.uint8] | None:
    """Colours of the sound triangles or points, read-only."""
    return None if colours is None else read_only(colours[np.asarray(is_sound)])


def read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """The array itself, made read-only, as parts share it."""
    array.flags.writeable = False
    return array


def _metric(vertices: NDArray[np.generic], scale: float) -> NDArray[np.float64]:
    """Positions in metres, contiguous."""
    positions = np.ascontiguousarray(vertices, dtype=np.float64)
    return positions if scale == 1.0 else positions * scale


def _compact(
    vertices: NDArray[Scalar], faces: NDArray[np.int64]
) -> tuple[NDArray[Scalar], NDArray[np.int64]]:
    """Drop unused vertices; the order stays.

    Pieces of a file may share one large array of vertices: for a small piece, sort its indices
    instead.
    """
    if faces.size * 8 < len(vertices):
        used, renumbered = np.unique(faces, return_inverse=True)
        return vertices[used], renumbered.reshape(-1, 3).astype(np.int64, copy=False)
    mask = np.zeros(len(vertices), dtype=bool)
    mask[faces] = True
    if mask.all():
        return vertices, np.ascontiguousarray(faces)
    return vertices[mask], (np.cumsum(mask) - 1)[faces]


def _count_degenerate(
    positions: NDArray[np.float64], faces: NDArray[np.int64], linear: NDArray[np.float64]
) -> int:
    """Number of triangles of zero area under the linear map (3, 3)."""
    # Edges are computed before the transform: far from the origin they would lose digits.
    first = positions[faces[:, 0]]
    a = (positions[faces[:, 1]] - first) @ linear.T
    b = (positions[faces[:, 2]] - first) @ linear.T
    # By columns: twice as fast as numpy's cross product of rows.
    x = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    y = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    z = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    longest = np.maximum(_squares(a), _squares(b))
    longest = np.maximum(longest, _squares(b - a))
    return int((np.sqrt(x * x + y * y + z * z) <= _FLAT * longest).sum())


def _squares(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.einsum("ij,ij->i", rows, rows), dtype=np.float64)


def _worlds(
    placements: list[Placement], geometries: list[NDArray[np.float64]], scale: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Transforms (P, 4, 4) in metres, and whether all points of a placement are finite in it."""
    worlds = np.array([p.world_from_part for p in placements], dtype=np.float64).reshape(-1, 4, 4)
    is_finite = np.isfinite(worlds).all(axis=(1, 2))
    bent = np.flatnonzero(is_finite & (worlds[:, 3] != [0, 0, 0, 1]).any(axis=1))
    if len(bent):
        name = _printable(placements[bent[0]].name)
        raise UnreadableError(f"the transform of '{name}' is not affine")
    # Once for each geometry, also when many placements share it.
    farthest = np.array([np.abs(v).max(axis=0, initial=0.0) for v in geometries]).reshape(-1, 3)
    worlds[:, :3, 3] *= scale
    corners = farthest[[placement.shape for placement in placements]]
    reach = np.einsum("pij,pj->pi", np.abs(worlds[:, :3, :3]), corners)
    reach += np.abs(worlds[:, :3, 3])
    # Squares of lengths must be finite as well, for areas and separations.
    return worlds, np.isfinite(_squares(reach))


def _printable(name: str) -> str:
    """Name without control characters or lone surrogates: valid in terminals, databases, JSON."""
    if name.isascii() and name.isprintable():
        return name.strip() or "part"
    whole = name.encode("utf-8", "replace").decode("utf-8")
    return "".join(" " if unicodedata.category(c) == "Cc" else c for c in whole).strip() or "part"


def _unique(name: str, taken: dict[str, int]) -> str:
    """Name, numbered from its second use on: 'wheel', 'wheel #2'; `taken` : last numbers."""
    candidate = name
    while candidate in taken:
        taken[name] += 1
        candidate = f"{name} #{taken[name]}"
    taken[candidate] = 1
    return candidate
