"""Distance of two surfaces during a screw motion, proved for all its turns in one plane.

A screw motion by h metres a radian changes neither the radius r of a place nor psi = z - h phi. On
r >= rho the gradients of r and of psi / sqrt(1 + (h / rho)^2) are at right angles and at most 1, so
the distance of two surfaces in these coordinates bounds their distance from below, at any angle.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces.triangle_bvh import TriangleBVH, triangle_bvh
from hapticdb.kernels.triangles.path_motion import PathMotion
from hapticdb.kernels.triangles.surface_distance import nearest

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

NODES = 8192
"""Nodes of a profile in a pitch."""
FINE, FINE_SHARE, ROUNDS, MOST_PIECES = 1e-7, 1e-3, 12, 200_000
"""Error of a triangle's profile, metres or a share of the greatest distance if more; bisections for
it, and their pieces, at most."""
EVEN, LEAST_PITCH, WIDEST = 1e-8, 1e-5, 0.5
"""Greatest error of a screw motion and its least pitch, metres; half the angle of a triangle."""
IN_WAY, MOST_IN_WAY = 0.5, 0.1
"""Radial clearance below which a triangle is excluded, as a share of the greatest distance; share
of triangles that may be."""


class Screw(NamedTuple):
    """Screw motion on segments first .. last - 1 of a path: `slope` metres a radian about an axis.

    frame (3, 3) : two directions across the axis, and the axis; at (3,) : a place on it; angle.
    """

    first: int
    last: int
    frame: Floats
    at: Floats
    slope: float
    angle: float


def screw_of(motion: PathMotion, reach: float) -> Screw | None:
    """The first screw motion of a path, if even for all places within `reach` of its centre."""
    angles = np.linalg.norm(motion.turns, axis=1)
    first = int(np.argmax(angles > 0.0))
    last = first + int(np.argmin(np.append(angles[first:] > 0.0, False)))
    if first == last:
        return None
    done = np.append(0.0, np.cumsum(angles[first:last]))
    axis = motion.turns[first:last].sum(axis=0)
    length = float(np.linalg.norm(axis))
    frame = np.linalg.svd(axis[None])[2][[1, 2, 0]]
    frame[2] = axis / (length or 1.0)
    frame[1] = np.cross(frame[2], frame[0])
    moved = motion.centers[first : last + 1] - motion.centers[first]
    slope = float(moved[-1] @ frame[2] / done[-1])
    off = np.linalg.norm(moved - np.outer(done, slope * frame[2]), axis=1).max()
    tilt = np.linalg.norm(
        motion.turns[first:last] - np.outer(np.diff(done), frame[2]), axis=1
    ).sum()
    if off + reach * tilt > EVEN or 2.0 * np.pi * abs(slope) < LEAST_PITCH:
        return None
    return Screw(first, last, frame, motion.centers[first], slope, float(done[-1]))


def gap_on_screw(
    thing: Floats, tool: Floats, screw: Screw, far: float, check_time: Callable[[], None]
) -> tuple[float, bool, Flags]:
    """Distance from below of two surfaces (T, 3, 3) while the tool, at its start, makes a screw.

    far : greatest distance of interest. Returns whether the tool is within the other surface, and
    flags of the inner one's triangles without a part in it, such as the end of a thread. Without a
    proof the distance is 0.
    """
    rise, sides = screw.slope * screw.angle, []
    for corners in (thing, tool):
        r, phi, z = _polar(corners, screw)
        sides.append((corners, r, _least_radius(r, phi), z))
    is_within = bool(sides[1][2].min() < sides[0][2].min())
    # a part may have the crests of a bolt alone: neither radius shows the inner surface for certain
    for swapped in (is_within, not is_within):
        inner, outer = sides[::-1] if swapped else sides
        moved = -rise if swapped else rise
        gap, rest = _gap_within(inner, outer, screw, moved, far, check_time)
        if gap > 0.0 and rest.mean() < MOST_IN_WAY:
            return gap, swapped, rest
    return 0.0, is_within, np.zeros(len(thing if not is_within else tool), dtype=np.bool_)


def _gap_within(
    inner: Sequence[Floats], outer: Sequence[Floats], screw: Screw, rise: float, far: float,
    check_time: Callable[[], None],
) -> tuple[float, Flags]:  # fmt: skip
    """The same for known sides: triangles, radii, least radii and heights of each."""
    triangles, r, _, z = inner
    around, _, least, heights = outer
    low, high = heights.min() + min(rise, 0.0) - far, heights.max() + max(rise, 0.0) + far
    # all others are farther than `far`, along the axis or across it
    is_met = (z.max(axis=1) > low) & (z.min(axis=1) < high) & (r.max(axis=1) > least.min() - far)
    is_outer = least < r[is_met].max(initial=0.0) + far
    gap, rest = far, np.zeros(len(triangles), dtype=np.bool_)
    if is_met.any() and is_outer.any():
        gap, left = _profile_gap(triangles[is_met], around[is_outer], screw, far, check_time)
        rest[np.flatnonzero(is_met)[left]] = True
    return gap, rest


def _profile_gap(
    inner: Floats, outer: Floats, screw: Screw, far: float, check_time: Callable[[], None]
) -> tuple[float, NDArray[np.int64]]:
    """Distance of two profiles from below, and the excluded triangles of the inner one."""
    none, period = np.zeros(0, dtype=np.int64), 2.0 * np.pi * abs(screw.slope)
    fine = max(FINE, FINE_SHARE * far)
    outwards, _, error, is_wide = _profile(outer, screw, fine, is_outer=True)
    rho = float(outwards[:, :, 0].min()) - error - far
    check_time()
    if is_wide.any() or rho <= 0.0:
        return 0.0, none
    depth, beyond = _highest(outwards * [-1.0, 1.0], np.full(NODES, np.inf), period)
    if beyond:
        return 0.0, none
    check_time()
    roof = -depth
    inwards, owners, own_error, is_wide = _profile(inner, screw, fine, is_outer=False)
    check_time()
    if is_wide.mean() > MOST_IN_WAY:
        return 0.0, none
    floor, in_way = _highest(inwards[~is_wide], roof - IN_WAY * far, period)
    left = np.append(owners[~is_wide][in_way], owners[is_wide])
    floor = np.maximum(floor, roof.min() - 2.0 * far)
    roof = np.minimum(roof, floor.max() + 2.0 * far)
    if (floor >= roof).any():
        return 0.0, none
    width = period / np.sqrt(1.0 + (screw.slope / rho) ** 2)
    gap = nearest(
        _polyline(floor, width, (-1, 0, 1)), _polyline(roof, width, (0,)),
        np.eye(4)[None], np.array([far]),
    ).at_least[0]  # fmt: skip
    return max(float(gap) - error - own_error - EVEN, 0.0), left


def _polar(triangles: Floats, screw: Screw) -> tuple[Floats, Floats, Floats]:
    """Radius, angle without a jump in a triangle, and height (T, 3) of its corners."""
    x, y, z = np.moveaxis((triangles - screw.at) @ screw.frame.T, 2, 0)
    angles = np.arctan2(y, x)
    turns = (angles - angles[:, :1] + np.pi) % (2.0 * np.pi) - np.pi
    return np.hypot(x, y), angles[:, :1] + turns, z


def _least_radius(radii: Floats, angles: Floats) -> Floats:
    """Distance (T,) of triangles from the axis: 0 around it, else that of an edge."""
    places = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1)
    edges = np.roll(places, -1, axis=1) - places
    squares = np.maximum((edges**2).sum(axis=-1, keepdims=True), 1e-300)
    shares = np.clip(-(places * edges).sum(axis=-1, keepdims=True) / squares, 0.0, 1.0)
    least = np.linalg.norm(places + shares * edges, axis=-1).min(axis=1)
    return np.where(np.ptp(angles, axis=1) < np.pi, least, 0.0)


def _profile(
    triangles: Floats, screw: Screw, fine: float, *, is_outer: bool
) -> tuple[Floats, NDArray[np.int64], float, Flags]:
    """Radius and psi (.., 3, 2) of triangles, bisected until each is almost a plane triangle.

    Returns the triangle of each, the greatest error in metres, and flags of those beyond `fine`.
    """
    owners = np.arange(len(triangles))
    for n_round in range(ROUNDS + 1):
        r, phi, z = _polar(triangles, screw)
        half = 0.5 * np.ptp(phi, axis=1)
        # a chord is nearer to the axis than its arc, and its angle is not linear
        sag = r.max(axis=1) * (1.0 - np.cos(half)) * is_outer
        bend = np.ptp(r, axis=1) * half / (2.0 * np.maximum(r.min(axis=1), 1e-9)) + 2.0 * half**3
        errors = np.where(half < WIDEST, np.hypot(sag, screw.slope * bend), np.inf)
        is_wide = errors > fine
        if not is_wide.any() or n_round == ROUNDS or len(triangles) > MOST_PIECES:
            break
        wide, rows = triangles[is_wide], np.arange(is_wide.sum())
        first = np.abs(phi - np.roll(phi, -1, axis=1))[is_wide].argmax(axis=1)
        a, b, c = (wide[rows, (first + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        halves = np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)
        triangles = np.concatenate([triangles[~is_wide], *halves])
        owners = np.concatenate([owners[~is_wide], owners[is_wide], owners[is_wide]])
    error = float(errors[~is_wide].max(initial=0.0))
    return np.stack([r, z - screw.slope * phi], axis=-1), owners, error, is_wide


def _highest(profiles: Floats, limit: Floats, period: float) -> tuple[Floats, list[int]]:
    """Upper bound (NODES,) of profiles, and the numbers of those beyond a limit.

    Those are excluded. Between nodes it is linear: so are the edges, each extended to whole steps,
    and the greatest of them is convex.
    """
    found, beyond, step = np.full(2 * NODES, -np.inf), [], period / NODES
    limits, steps = np.tile(limit, 2), np.arange(NODES)
    edges = np.stack([profiles, np.roll(profiles, -1, axis=1)], axis=2)  # (T, 3, 2, [r, psi])
    (ra, pa), (rb, pb) = np.moveaxis(edges, (2, 3), (0, 1))
    first = np.floor(np.minimum(pa, pb) / step).astype(np.int64)
    counts = np.ceil(np.maximum(pa, pb) / step).astype(np.int64) - first + 1
    is_short = np.abs(pb - pa) < step
    slopes = np.where(is_short, 0.0, (rb - ra) / np.where(is_short, 1.0, pb - pa)) * step
    starts = np.where(is_short, np.maximum(ra, rb), ra + slopes * (first - pa / step))
    first %= NODES
    for n, edge in enumerate(
        zip(*(one.tolist() for one in (first, counts, starts, slopes)), strict=True)
    ):
        values = []
        for begin, count, start, slope in zip(*edge, strict=True):
            if count > NODES:
                break
            values.append((slice(begin, begin + count), start + slope * steps[:count]))
        if len(values) < 3 or any((row > limits[part]).any() for part, row in values):
            beyond.append(n)
            continue
        for part, row in values:
            np.maximum(found[part], row, out=found[part])
    return np.maximum(found[:NODES], found[NODES:]), beyond


def _polyline(radii: Floats, width: float, turns: tuple[int, ...]) -> TriangleBVH:
    """BVH of a profile's segments, in some turns."""
    x = (np.arange(NODES * len(turns) + 1) / NODES + turns[0]) * width
    places = np.stack([np.append(np.tile(radii, len(turns)), radii[0]), x, 0.0 * x], axis=1)
    segments = np.stack([places[:-1], places[1:], places[1:]], axis=1)
    return triangle_bvh(segments, np.zeros(len(segments), dtype=np.int64))
