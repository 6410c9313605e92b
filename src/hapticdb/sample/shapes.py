"""Parametric solids: closed triangle meshes, wound outward, from numpy alone.

No boolean operation is needed anywhere: a hole is a shape of its own (a ring of quadrilaterals
around it), and a part may be several closed shells. Lengths are in metres, angles in degrees.
Unless said otherwise a shape is centred on the origin with its axis along z.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


class Mesh(NamedTuple):
    """A closed surface: vertices (V, 3) in metres and outward faces (F, 3) of vertex numbers."""

    vertices: Floats
    faces: NDArray[np.int64]


# ---- transforms -------------------------------------------------------------------------------


def shift(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Floats:
    """Translation as a (4, 4) matrix."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def turn(axis: str, degrees: float) -> Floats:
    """Right-handed rotation about the axis 'x', 'y' or 'z' as a (4, 4) matrix."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    angle = np.radians(degrees)
    matrix = np.eye(4)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[j, i] = np.sin(angle)
    matrix[i, j] = -matrix[j, i]
    return matrix


def aligned(start: ArrayLike, end: ArrayLike) -> Floats:
    """Rigid (4, 4) transform that carries the z axis onto the line from `start` to `end`."""
    origin = np.asarray(start, dtype=np.float64)
    z = np.asarray(end, dtype=np.float64) - origin
    z /= np.linalg.norm(z)
    other = np.eye(3)[np.argmin(np.abs(z))]
    y = np.cross(z, other)
    y /= np.linalg.norm(y)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([np.cross(y, z), y, z])
    matrix[:3, 3] = origin
    return matrix


def moved(mesh: Mesh, world_from_mesh: Floats) -> Mesh:
    """The mesh carried by a rigid (4, 4) transform."""
    return Mesh(mesh.vertices @ world_from_mesh[:3, :3].T + world_from_mesh[:3, 3], mesh.faces)


def mirrored(mesh: Mesh) -> Mesh:
    """The mesh reflected in the plane y = 0, still wound outward."""
    return Mesh(mesh.vertices * [1.0, -1.0, 1.0], mesh.faces[:, ::-1])


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Several closed shells as one mesh."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.vstack([mesh.vertices for mesh in meshes]),
        np.vstack([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
    )


def repeated(mesh: Mesh, placements: Sequence[Floats]) -> Mesh:
    """Copies of one mesh at several placements, as one mesh."""
    return join([moved(mesh, placement) for placement in placements])


# ---- the two surfaces that everything is made of ---------------------------------------------


def volume(mesh: Mesh) -> float:
    """Signed volume in cubic metres: positive when the faces are wound outward."""
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def outward(mesh: Mesh) -> Mesh:
    """The mesh with its faces wound outward."""
    return mesh if volume(mesh) > 0.0 else Mesh(mesh.vertices, mesh.faces[:, ::-1])


def _triangles(quads: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _quads(rows: int, columns: int, *, wrap_rows: bool, wrap_columns: bool) -> NDArray[np.int64]:
    """Corners (Q, 4) of the cells of a grid of points numbered row by row."""
    grid = np.meshgrid(
        np.arange(rows if wrap_rows else rows - 1),
        np.arange(columns if wrap_columns else columns - 1),
        indexing="ij",
    )
    i, j = (axis.ravel().astype(np.int64) for axis in grid)
    down, right = (i + 1) % rows, (j + 1) % columns
    return np.stack(
        [i * columns + j, down * columns + j, down * columns + right, i * columns + right], axis=1
    )


def loft(sections: ArrayLike, *, ring: bool = False) -> Mesh:
    """Solid through closed sections.

    Parameters
    ----------
    sections : array_like
        (M, K, 3): M closed outlines of K points each, in metres.
    ring : bool
        Join the last section to the first (a torus); otherwise both ends are closed by a fan
        about the section's mean, which must see all of it.
    """
    points = np.asarray(sections, dtype=np.float64)
    rows, columns = points.shape[:2]
    vertices = points.reshape(-1, 3)
    faces = _triangles(_quads(rows, columns, wrap_rows=ring, wrap_columns=True))
    if ring:
        return outward(Mesh(vertices, faces))
    first: NDArray[np.int64] = np.arange(columns, dtype=np.int64)
    after = np.roll(first, -1)
    last = first + (rows - 1) * columns
    centre = np.full(columns, rows * columns)
    caps = [
        np.stack([centre, first, after], axis=1),
        np.stack([centre + 1, np.roll(last, -1), last], axis=1),
    ]
    vertices = np.vstack([vertices, points[0].mean(axis=0), points[-1].mean(axis=0)])
    return outward(Mesh(vertices, np.vstack([faces, *caps])))


def sheet(surface: ArrayLike, thickness: float, kept: NDArray[np.bool_] | None = None) -> Mesh:
    """Sheet of a thickness on one side of a surface.

    Parameters
    ----------
    surface : array_like
        (M, N, 3) grid of points in metres.
    thickness : float
        Metres; the second side lies against the normals d/drow x d/dcolumn.
    kept : ndarray, optional
        (M - 1, N - 1): which cells of the grid are there; the others are holes. Holes must not
        meet in one corner only.
    """
    points = np.asarray(surface, dtype=np.float64)
    rows, columns = points.shape[:2]
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    quads = _quads(rows, columns, wrap_rows=False, wrap_columns=False)
    if kept is not None:
        quads = quads[kept.ravel()]
    back = points - thickness * normals
    return thickened(points.reshape(-1, 3), back.reshape(-1, 3), quads)


def thickened(front: Floats, back: Floats, quads: NDArray[np.int64]) -> Mesh:
    """Solid between two copies (V, 3) of a surface of quads (Q, 4), walled along its borders."""
    n = len(front)
    edges = np.vstack([quads[:, [0, 1]], quads[:, [1, 2]], quads[:, [2, 3]], quads[:, [3, 0]]])
    border = edges[~np.isin(edges[:, 0] * n + edges[:, 1], edges[:, 1] * n + edges[:, 0])]
    walls = np.stack([border[:, 1], border[:, 0], border[:, 0] + n, border[:, 1] + n], axis=1)
    faces = _triangles(np.vstack([quads, quads[:, ::-1] + n, walls]))
    used, numbers = np.unique(faces, return_inverse=True)
    return outward(Mesh(np.vstack([front, back])[used], numbers.reshape(-1, 3)))


# ---- outlines (K, 2) -------------------------------------------------------------------------


def circle(radius: float, segments: int = 24) -> Floats:
    """Regular polygon on a circle."""
    angle = np.arange(segments) * (2.0 * np.pi / segments)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def rounded_rectangle(width: float, depth: float, radius: float, steps: int = 3) -> Floats:
    """Rectangle with corners rounded in `steps` segments each."""
    angle = np.radians(np.linspace(0.0, 90.0, steps + 1))
    corner = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centre = np.array([width / 2.0 - radius, depth / 2.0 - radius])
    arcs = []
    for quarter in range(4):
        cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
        signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))[quarter]
        arcs.append(corner @ np.array([[cos, sin], [-sin, cos]]) + centre * signs)
    return np.vstack(arcs)


def gear_outline(teeth: int, pitch_radius: float, bore: float) -> tuple[Floats, Floats]:
    """Outlines of a spur gear: teeth (12 points each, 20 degrees of pressure angle) and bore.

    The flanks are straight chords of the involute, on a module of 2 pitch_radius / teeth.
    """
    module = 2.0 * pitch_radius / teeth
    radii = pitch_radius + module * np.array([-1.2, -1.2, -0.6, 0.0, 0.5, 0.95])
    half = np.pi / (2.0 * teeth)
    base = pitch_radius * np.cos(np.radians(20.0))
    roll = np.sqrt(np.maximum((radii / base) ** 2 - 1.0, 0.0))
    pitch_roll = np.tan(np.radians(20.0))
    width = half + (pitch_roll - np.arctan(pitch_roll)) - (roll - np.arctan(roll))
    width[0] = 2.0 * half - 0.25 * half
    flank = np.concatenate([-width, width[::-1]])
    angle = (np.arange(teeth)[:, None] * (2.0 * np.pi / teeth) + flank).ravel()
    radius = np.tile(np.concatenate([radii, radii[::-1]]), teeth)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # the bore's points are spread evenly: under an undercut two of the tooth's share an angle
    return radius[:, None] * direction, np.roll(circle(bore, 12 * teeth), 6, axis=0)


# ---- solids ----------------------------------------------------------------------------------


def at_height(outline: Floats, z: float) -> Floats:
    """An outline (K, 2) as points (K, 3) at one height."""
    return np.column_stack([outline, np.full(len(outline), z)])


def extrude(outline: Floats, bottom: float, top: float) -> Mesh:
    """Prism over an outline that its mean sees all of."""
    return loft([at_height(outline, bottom), at_height(outline, top)])


def box(x: float, y: float, z: float, edge: float = 0.004, steps: int = 2) -> Mesh:
    """Box with rounded vertical edges and chamfered top and bottom."""
    outer = rounded_rectangle(x, y, edge, steps)
    scale = np.array([(x - 2.0 * edge) / x, (y - 2.0 * edge) / y])
    inner = outer * np.maximum(scale, 0.2)
    rise = min(edge, 0.4 * z)
    heights = (-z / 2.0, rise - z / 2.0, z / 2.0 - rise, z / 2.0)
    outlines = (inner, outer, outer, inner)
    return loft([at_height(o, h) for o, h in zip(outlines, heights, strict=True)])


def slab(x: float, y: float, z: float) -> Mesh:
    """Plain box: what thin fins and plates are made of."""
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * [x / 2.0, y / 2.0]
    return extrude(corners, -z / 2.0, z / 2.0)


def turned(profile: ArrayLike, segments: int = 24) -> Mesh:
    """Solid of revolution. profile (K, 2): radius and z along the outline, both ends flat."""
    return loft([at_height(circle(r, segments), z) for r, z in np.asarray(profile)])


def lathe(profile: ArrayLike, segments: int = 32) -> Mesh:
    """Ring of revolution. profile (K, 2): radius and z of a closed outline beside the axis."""
    r, z = np.asarray(profile, dtype=np.float64).T
    directions = circle(1.0, segments)
    return loft(
        np.stack(
            [r * directions[:, :1], r * directions[:, 1:], np.broadcast_to(z, (segments, len(z)))],
            axis=2,
        ),
        ring=True,
    )


def cylinder(radius: float, length: float, segments: int = 20) -> Mesh:
    """Cylinder with small chamfers."""
    c = min(0.1 * radius, 0.1 * length)
    h = length / 2.0
    return turned([(radius - c, -h), (radius, c - h), (radius, h - c), (radius - c, h)], segments)


def tube(outer: float, inner: float, length: float, segments: int = 24) -> Mesh:
    """Hollow cylinder, open at both ends."""
    h = length / 2.0
    return lathe([(inner, -h), (outer, -h), (outer, h), (inner, h)], segments)


def torus(radius: float, wire: float, segments: int = 32, sides: int = 10) -> Mesh:
    """Ring of round section."""
    return lathe(circle(wire, sides) + np.array([radius, 0.0]), segments)


def ball(radius: float, segments: int = 16) -> Mesh:
    """Sphere of latitude rings."""
    angle = np.radians(np.linspace(-88.0, 88.0, segments // 2 + 1))
    return turned(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1), segments)


def ring_plate(outer: Floats, inner: Floats, bottom: float, top: float) -> Mesh:
    """Plate between two outlines of equally many points: a plate with one hole."""
    return loft(
        np.stack(
            [
                at_height(outer, bottom),
                at_height(outer, top),
                at_height(inner, top),
                at_height(inner, bottom),
            ],
            axis=1,
        ),
        ring=True,
    )


def bored_block(x: float, y: float, z: float, bore: float, segments: int = 24) -> Mesh:
    """Rectangular block with a round hole along z."""
    direction = circle(1.0, segments)
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * [x / 2.0, y / 2.0]
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    direction[np.argmax(direction @ corners.T, axis=0)] = corners
    reach = np.minimum(
        x / 2.0 / np.maximum(np.abs(direction[:, 0]), 1e-9),
        y / 2.0 / np.maximum(np.abs(direction[:, 1]), 1e-9),
    )
    return ring_plate(reach[:, None] * direction, bore * direction, -z / 2.0, z / 2.0)


def gear(teeth: int, pitch_radius: float, width: float, bore: float) -> Mesh:
    """Spur gear with a bore."""
    outline, hole = gear_outline(teeth, pitch_radius, bore)
    return ring_plate(outline, hole, -width / 2.0, width / 2.0)


def hex_bolt(across_flats: float, length: float) -> Mesh:
    """Bolt: hexagon head with its washer face at z = 0, shank towards -z."""
    radius = across_flats / np.sqrt(3.0)
    head = loft(
        [
            at_height(circle(r, 6), z)
            for r, z in (
                (radius, 0.0),
                (radius, 0.5 * across_flats),
                (0.85 * radius, 0.62 * across_flats),
            )
        ]
    )
    shank = moved(cylinder(0.32 * across_flats, length, 12), shift(z=-length / 2.0))
    washer = moved(cylinder(0.72 * across_flats, 0.12 * across_flats, 18), shift(z=0.0))
    return join([head, washer, shank])


# ---- sweeps ----------------------------------------------------------------------------------


def bent(points: ArrayLike, steps: int = 4) -> Floats:
    """Smooth path (M, 3) through points (P, 3): a Catmull-Rom curve, `steps` a stretch."""
    p = np.asarray(points, dtype=np.float64)
    p = np.vstack([2.0 * p[0] - p[1], p, 2.0 * p[-1] - p[-2]])
    t = (np.arange(steps) / steps)[:, None]
    stretches = []
    for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True):
        cubic = -a + 3.0 * b - 3.0 * c + d
        square = 2.0 * a - 5.0 * b + 4.0 * c - d
        stretches.append(0.5 * (2.0 * b + t * (c - a) + t**2 * square + t**3 * cubic))
    return np.vstack([*stretches, p[-2:-1]])


def helix(radius: float, length: float, turns: float, steps: int = 16) -> Floats:
    """Path (M, 3) of a spring: its end turns lie flat."""
    u = np.linspace(0.0, 1.0, int(turns * steps) + 1)
    angle = 2.0 * np.pi * turns * u
    rise = np.interp(u * turns, [0.0, 0.8, turns - 0.8, turns], [0.0, 0.02, 0.98, 1.0])
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), length * (rise - 0.5)])


def _frames(path: Floats, *, ring: bool) -> tuple[Floats, Floats]:
    """Two unit vectors (M, 3) across the path at each point, turning with it and not about it."""
    tangents = (
        np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0) if ring else np.gradient(path, axis=0)
    )
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    side = np.cross(np.eye(3)[np.argmin(np.abs(tangents[0]))], tangents[0])
    sides = np.empty_like(path)
    for i, tangent in enumerate(tangents):
        side = side - (side @ tangent) * tangent
        side /= np.linalg.norm(side)
        sides[i] = side
    return sides, np.cross(tangents, sides)


def sweep(path: ArrayLike, section: Floats, *, ring: bool = False) -> Mesh:
    """Solid swept by a section (K, 2) along a path (M, 3); `ring` closes a plane path on itself."""
    points = np.asarray(path, dtype=np.float64)
    sides, ups = _frames(points, ring=ring)
    sections = points[:, None] + section[:, :1] * sides[:, None] + section[:, 1:] * ups[:, None]
    return loft(sections, ring=ring)


def rod(path: ArrayLike, radius: float, sides: int = 10) -> Mesh:
    """Round bar along a path (M, 3)."""
    return sweep(path, circle(radius, sides))


def pipe(path: ArrayLike, outer: float, inner: float, sides: int = 16) -> Mesh:
    """Hollow round bar along a path (M, 3), open at both ends."""
    points = np.asarray(path, dtype=np.float64)
    across, ups = _frames(points, ring=False)
    direction = circle(1.0, sides)
    offsets = direction[:, :1] * across[:, None] + direction[:, 1:] * ups[:, None]
    outside = points[:, None] + outer * offsets
    inside = points[:, None] + inner * offsets
    return loft(np.concatenate([outside, inside[::-1]]), ring=True)


def spring(radius: float, wire: float, length: float, turns: float, sides: int = 8) -> Mesh:
    """Helical spring of round wire."""
    return rod(helix(radius, length, turns), wire, sides)


def belt(pulleys: Sequence[tuple[float, float, float]], width: float, thickness: float) -> Mesh:
    """Flat belt around pulleys (x, y, radius) in the plane z = 0: their convex hull, thickened."""
    points = np.vstack([circle(r, 36) + np.array([x, y]) for x, y, r in pulleys])
    outline = _hull(points)
    ahead, behind = np.roll(outline, -1, axis=0), np.roll(outline, 1, axis=0)
    tangent = ahead - behind
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return ring_plate(outline + thickness * normal, outline, -width / 2.0, width / 2.0)


def _hull(points: Floats) -> Floats:
    """Convex hull (K, 2) of points in the plane, counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted(map(tuple, points.tolist()))
    chains: list[list[tuple[float, ...]]] = []
    for sequence in (ordered, ordered[::-1]):
        chain: list[tuple[float, ...]] = []
        for x, y in sequence:
            while len(chain) > 1 and (
                (chain[-1][0] - chain[-2][0]) * (y - chain[-2][1])
                <= (chain[-1][1] - chain[-2][1]) * (x - chain[-2][0]) + 1e-12
            ):
                chain.pop()
            chain.append((x, y))
        chains.append(chain[:-1])
    return np.array(chains[0] + chains[1])
