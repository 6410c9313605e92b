"""Chord error of a tessellation, from positions and normals of the CAD surface at its vertices.

OpenCASCADE puts vertices on the CAD surface and writes the surface's normals there. Over a triangle
the surface is taken for the cubic patch with these corners and normals (Vlachos et al. 2001,
"Curved PN triangles"); the greatest of its heights above the triangle, sampled, is the chord error.
The mesher's tolerance proves nothing: one face of a real file exceeds it up to 13 times.

Vertices of finer tessellations show at least how large it is: for 25 shapes at 2 tolerances it is
1.18 to 1.4 times what these show, 2.2 at most. Without `MARGIN` the least is 0.94, of a spline of
short waves. docs/decisions/0024 has the figures, and says why no second tessellation is made: it
takes longer than the first, and shows nothing where it refines nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.mesh.raw import Shape, told
from hapticdb.units import length_text

Floats = NDArray[np.float64]

DEFAULT = 1e-5
"""Greatest chord error wanted of a STEP file unless given, metres. A smaller value: more triangles,
and more time where surfaces are curved both ways."""
LEAST, MOST = 1e-7, 1.0
"""Range of the chord error that may be asked for, metres. Below it a part of a few centimetres has
millions of triangles, whose 32-bit positions are as coarse."""
MARGIN = 1.25
"""Factor on the height that the patches have: for what a cubic patch misses."""

_OVER = 1.05
"""Times the wanted chord error from which on a larger one is told."""
_STEPS = 6
"""Steps of the lattice over a triangle where heights are sampled: halves and thirds are in it."""
_STEEP = math.sin(math.pi / 3)
"""Sine of the angle between an edge and the surface beyond which the normal is not believed. The
mesher allows half a radian between neighbours."""
_SMOOTH, _KNIFE = 0.9, 1e-4
"""Cosine of the angle between normals above which faces meet smoothly; least square of its sine."""
_ROUNDED = 1e-7
"""Rounding of a normal of 32-bit numbers, at most."""
_AT_ONCE = 1 << 16
"""Triangles at once. A larger value takes more memory."""
_NEXT, _LAST = (1, 2, 0), (2, 0, 1)
_MIXERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)
"""Odd numbers that spread the bits of a position over a hash."""


def check_chord(metres: float | None) -> None:
    """Raise UsageError if a chord error to ask for, metres, is out of range."""
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


def told_coarser(shapes: Sequence[Shape], wanted: float) -> list[str]:
    """Note of how far tessellations are from the chord error that was wanted, metres."""
    over = [one.chord for one in shapes if one.chord > _OVER * wanted]
    worst = length_text(max(over, default=0.0))
    words = "shape{s} {are} tessellated with a chord error of up to {worst}, not {wanted} as wanted"
    return told(len(over), words, worst=worst, wanted=length_text(wanted))


def chord_error(
    vertices: NDArray[np.generic],
    normals: NDArray[np.generic] | None,
    faces: NDArray[np.int64],
    wanted: float,
) -> float:
    """Greatest distance between triangles and the CAD surface that they stand for; 0 if it is flat.

    Where a surface ends, the curve of its border is in no normal: then, and without normals, it is
    at least `wanted`, for which the mesher was given `wanted / MARGIN` (on circles it needs half).

    Parameters
    ----------
    vertices, normals, faces : arrays
        Positions (V, 3) and unit normals (V, 3), of each CAD face its own; corners (F, 3).
    wanted : float
        Chord error that the mesher was asked for, the vertices' unit.
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
    """Greatest height of the patches above their triangles."""
    corners = vertices[faces].astype(np.float64)
    sides = corners[:, _NEXT] - corners
    upright = normals[faces].astype(np.float64)
    ahead, is_steep = _rise(sides, upright, rounding)
    back, is_steep_back = _rise(-sides[:, _LAST], upright, rounding)
    unsure = is_singular[faces]
    lost = (unsure | is_steep) & ~unsure[:, _NEXT], (unsure | is_steep_back) & ~unsure[:, _LAST]
    # Without a normal at one end, an edge is taken for an arc: as high there as at the other end.
    ahead, back = np.where(lost[0], back[:, _NEXT], ahead), np.where(lost[1], ahead[:, _LAST], back)
    middle = 1.5 * (ahead.sum(axis=1) + back.sum(axis=1)) / 6.0
    heights = np.concatenate([ahead, back, middle[:, None]], axis=1) @ _weights().T
    return float(np.abs(heights).max(initial=0.0))


def _rise(sides: Floats, normals: Floats, rounding: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Heights (F, 3) of control points on sides (F, 3, 3), by the normals at the sides' starts.

    With them whether a side is too steep for its normal to be one. On planes they are 0, whatever
    the rounding of 32-bit positions and normals.
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
    """Shares (points, 7) of a patch's control heights at the points of the lattice."""
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
    """Greatest distance of a curve where two CAD faces meet from the edge that stands for it.

    pairs (n, 2, 2) : the edge's ends on one face and on the other. On a sharp edge the curve may
    leave both faces' triangles sideways, unseen by either normal: the shift has a component along
    each of them, and is the shortest vector that has both. Faces that meet smoothly need none.
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
    """Ends (n, 2, 2) of edges on the two CAD faces that meet there, and whether some edge is free.

    Faces have vertices of their own, so edges meet by their positions, which are hashed.
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
