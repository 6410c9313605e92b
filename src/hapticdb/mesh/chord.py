"""Chord error of a tessellation, from positions and normals of the CAD surface at its vertices.

OpenCASCADE puts vertices on the CAD surface, with the surface's normals. Over a triangle the
surface is approximated by the cubic patch with these corners and normals (Vlachos et al. 2001,
"Curved PN triangles"); its greatest sampled height above the triangle is the chord error. The
mesher's tolerance proves nothing: one face of a real file exceeds it up to 13 times.

Vertices of finer tessellations give a lower bound. For 25 shapes at 2 tolerances the estimate is
1.18 to 1.4 times that bound, 2.2 at most; without `MARGIN` the least is 0.94, of a spline of short
waves. docs/decisions/0024 has the figures, and the case against a second tessellation: it takes
longer than the first, and shows nothing where it refines nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.mesh.parsed import Shape, count_note
from hapticdb.units import length_text

Floats = NDArray[np.float64]

DEFAULT = 1e-5
"""Greatest chord error of a STEP file unless given, metres."""
LEAST, MOST = 1e-7, 1.0
"""Range of a requested chord error, metres. Below it a part of a few centimetres has millions of
triangles, and 32-bit positions are as coarse."""
MARGIN = 1.25
"""Factor on the patch heights, for the approximation error of a cubic patch."""

_STEPS = 6
"""Subdivisions of the lattice of height samples on a triangle; it contains halves and thirds."""
_STEEP = math.sin(math.pi / 3)
"""Sine of the angle between an edge and the surface above which the normal is rejected. The mesher
allows half a radian between neighbours."""
_SMOOTH, _KNIFE = 0.9, 1e-4
"""Cosine of the angle between normals above which faces meet smoothly; least square of its sine."""
_ROUNDED = 1e-7
"""Greatest rounding error of a normal of 32-bit numbers."""
_AT_ONCE = 1 << 16
"""Triangles of a batch. A larger value takes more memory."""
_NEXT, _LAST = (1, 2, 0), (2, 0, 1)
_MIXERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)
"""Odd multipliers of a hash of positions."""


def check_chord(metres: float | None) -> None:
    """Raise UsageError for a chord error, metres, out of range."""
    if metres is not None and not LEAST <= metres <= MOST:
        raise UsageError(
            f"a chord error of {metres * 1e3:g} mm: give {LEAST * 1e3:g} mm to {length_text(MOST)}"
        )


def measured(shape: Shape, wanted: float) -> Shape:
    """Shape with its chord error, without its normals; `wanted` as for `chord_error`."""
    if shape.faces is None:
        return shape
    faces = np.asarray(shape.faces, dtype=np.int64)
    error = chord_error(shape.vertices, shape.normals, faces, wanted)
    return replace(shape, chord=error, normals=None)


def coarser_note(shapes: Sequence[Shape], wanted: float) -> list[str]:
    """Note of shapes with a chord error above the requested one, metres."""
    over = [one.chord for one in shapes if one.chord > 1.05 * wanted]
    worst = length_text(max(over, default=0.0))
    words = "shape{s} {are} tessellated with a chord error of up to {worst}, not {wanted} as wanted"
    return count_note(len(over), words, worst=worst, wanted=length_text(wanted))


def chord_error(
    vertices: NDArray[np.generic],
    normals: NDArray[np.generic] | None,
    faces: NDArray[np.int64],
    wanted: float,
) -> float:
    """Greatest distance between triangles and their CAD surface; 0 if it is flat.

    No normal shows the curve of a free border. So with a free border, or without normals, the
    result is at least `wanted`: the mesher's tolerance is `wanted / MARGIN` (on circles it needs
    half).

    vertices (V, 3), normals (V, 3) : separate for each CAD face; wanted : chord error requested of
    the mesher, the vertices' unit.
    """
    rounding = float(np.spacing(np.abs(vertices).max(initial=0.0)))
    if normals is None:
        return wanted + rounding
    is_singular = np.zeros(len(vertices), dtype=bool)
    blocks = [faces[at : at + _AT_ONCE] for at in range(0, len(faces), _AT_ONCE)]
    for some in blocks:
        corners = vertices[some]
        meets = (corners == corners[:, _NEXT]).all(axis=2)
        for here in (some, some[:, _NEXT]):  # poles and apexes, where a face has no normal
            is_singular[here[meets]] = True
    heights = [_height(vertices, normals, some, is_singular, rounding) for some in blocks]
    pairs, is_open = _edges(vertices, faces)
    borders = wanted / MARGIN if is_open else 0.0
    height = max([*heights, _sag(vertices, normals, pairs, is_singular, rounding), borders])
    return MARGIN * height + rounding if height else 0.0


def _height(
    vertices: NDArray[np.generic],
    normals: NDArray[np.generic],
    faces: NDArray[np.int64],
    is_singular: NDArray[np.bool_],
    rounding: float,
) -> float:
    """Greatest height of the cubic patches above their triangles."""
    corners = vertices[faces].astype(np.float64)
    sides = corners[:, _NEXT] - corners
    upright = normals[faces].astype(np.float64)
    ahead, is_steep = _rise(sides, upright, rounding)
    back, is_steep_back = _rise(-sides[:, _LAST], upright, rounding)
    unsure = is_singular[faces]
    lost = (unsure | is_steep) & ~unsure[:, _NEXT], (unsure | is_steep_back) & ~unsure[:, _LAST]
    # Without a normal at one end, assume an arc: the same height as at the other end.
    ahead, back = np.where(lost[0], back[:, _NEXT], ahead), np.where(lost[1], ahead[:, _LAST], back)
    middle = 1.5 * (ahead.sum(axis=1) + back.sum(axis=1)) / 6.0
    heights = np.concatenate([ahead, back, middle[:, None]], axis=1) @ _weights().T
    return float(np.abs(heights).max(initial=0.0))


def _rise(sides: Floats, normals: Floats, rounding: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Heights (F, 3) of control points on sides (F, 3, 3), by the normals at the sides' starts.

    Also whether a side is too steep for a valid normal. Heights on planes are 0, whatever the
    rounding of 32-bit positions and normals.
    """
    over = -np.einsum("fkd,fkd->fk", sides, normals)
    lengths = np.sqrt(np.einsum("fkd,fkd->fk", sides, sides))
    over[np.abs(over) <= 2.0 * rounding + _ROUNDED * lengths] = 0.0
    sine = np.divide(over, lengths, out=np.zeros_like(over), where=lengths > 0.0)
    is_steep = ~(np.abs(sine) <= _STEEP)  # or NaN
    sine = np.clip(np.where(np.isnan(sine), 0.0, sine), -_STEEP, _STEEP)
    return lengths * sine / (3.0 * np.sqrt(1.0 - sine * sine)), is_steep


@cache
def _weights() -> Floats:
    """Bernstein weights (points, 7) of a patch's control heights at the points of the lattice."""
    rows = []
    for i in range(_STEPS + 1):
        for j in range(_STEPS + 1 - i):
            u = np.array([i, j, _STEPS - i - j]) / _STEPS
            rows.append([*3 * u**2 * u[[*_NEXT]], *3 * u**2 * u[[*_LAST]], 6 * u.prod()])
    return np.array(rows)


def _sag(
    vertices: NDArray[np.generic],
    normals: NDArray[np.generic],
    pairs: NDArray[np.int64],
    is_singular: NDArray[np.bool_],
    rounding: float,
) -> float:
    """Greatest distance of a curve between two CAD faces from its edge.

    pairs (n, 2, 2) : the edge's ends on one face and on the other. On a sharp edge the curve may
    leave both faces' triangles sideways, invisible to either normal: its offset is the shortest
    vector with the given components along both. Smooth edges need none.
    """
    greatest, positions = 0.0, vertices.astype(np.float64)
    for one, other in ((0, 1), (1, 0)):
        here, there = pairs[:, 0, one], pairs[:, 1, one]
        sides = positions[pairs[:, 0, other]] - positions[here]
        upright = [normals[side].astype(np.float64) for side in (here, there)]
        (a, is_steep), (b, is_steep_too) = (
            _rise(sides[:, None], n[:, None], rounding) for n in upright
        )
        cosine = np.einsum("nd,nd->n", *upright)
        is_sharp = cosine < _SMOOTH
        is_sharp &= ~(is_singular[here] | is_singular[there] | (is_steep | is_steep_too)[:, 0])
        a, b, cosine = a[is_sharp, 0], b[is_sharp, 0], cosine[is_sharp]
        squares = (a * a + b * b - 2.0 * a * b * cosine) / np.maximum(1.0 - cosine**2, _KNIFE)
        greatest = max(greatest, float(np.sqrt(squares.max(initial=0.0))))
    return 0.75 * greatest  # of an arc, by the height of its control points


def _edges(
    vertices: NDArray[np.generic], faces: NDArray[np.int64]
) -> tuple[NDArray[np.int64], bool]:
    """Ends (n, 2, 2) of edges on their two CAD faces, and whether some edge is free.

    CAD faces do not share vertices, so edges are matched by hashes of positions.
    """
    bits = (np.ascontiguousarray(vertices, dtype=np.float32) + np.float32(0)).view(np.uint32)
    mixed = (bits.astype(np.uint64) * _MIXERS).sum(axis=1, dtype=np.uint64)
    mixed ^= mixed >> np.uint64(32)
    mixed *= _MIXERS[0]
    mixed ^= mixed >> np.uint64(29)
    ends = np.stack([faces, faces[:, _NEXT]], axis=2).reshape(-1, 2)
    hashed = mixed[ends]
    is_whole = hashed[:, 0] != hashed[:, 1]
    ends, hashed = ends[is_whole], hashed[is_whole]
    keys = hashed.sum(axis=1, dtype=np.uint64)
    order = np.argsort(keys)
    is_same = np.diff(keys[order]) == 0
    is_met = np.concatenate([[False], is_same]) | np.concatenate([is_same, [False]])
    first, second = order[:-1][is_same], order[1:][is_same]
    is_turned = hashed[first, 0] != hashed[second, 0]
    pairs = np.stack([ends[first], ends[second]], axis=1)
    pairs[is_turned, 1] = pairs[is_turned, 1, ::-1]
    return pairs[(pairs[:, 0] != pairs[:, 1]).any(axis=1)], not is_met[: len(keys)].all()
