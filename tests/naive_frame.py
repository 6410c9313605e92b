"""One frame in plain Python, slow and obviously right: the oracle of every strategy."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb import Grid, PointShell

Triple = tuple[float, float, float]
Voxel = tuple[int, int, int]


@dataclass
class NaiveTouch:
    """The result that a frame must have."""

    force: Triple
    torque: Triple
    hits: list[int]
    depths: list[float]
    pairs: list[tuple[int, int]]
    apart: list[int] = field(default_factory=list)
    """Felt points that are no hits."""
    apart_depths: list[float] = field(default_factory=list)
    near: list[tuple[int, int]] = field(default_factory=list)
    """Felt points, each with every object that it touches, under the distance law."""

    @property
    def contacts(self) -> list[int]:
        return sorted(self.contact_depths)

    @property
    def contact_depths(self) -> dict[int, float]:
        both = [*zip(self.hits, self.depths, strict=True)]
        both += zip(self.apart, self.apart_depths, strict=True)
        return {n: d for n, d in both if d > 0}

    @property
    def ids(self) -> list[int]:
        return sorted({i for _, i in self.pairs} | {i for _, i in self.near})


def transform(pose: list[list[float]], v: Triple, *, shift: bool) -> Triple:
    """Turn v by a pose; if v is a point, shift it, too."""
    turned = [row[0] * v[0] + row[1] * v[1] + row[2] * v[2] for row in pose[:3]]
    if shift:
        turned = [t + row[3] for t, row in zip(turned, pose, strict=False)]
    return turned[0], turned[1], turned[2]


def voxel_of(p: Triple, origin: Triple, size: float) -> Voxel:
    """The voxel [i s, (i + 1) s) that holds p."""
    i, j, k = (math.floor((x - o) / size) for x, o in zip(p, origin, strict=True))
    return i, j, k


def below_plane(p: Sequence[float], n: Sequence[float], c: Sequence[float], _: float) -> float:
    """Depth of point p with inward normal n below the plane through the voxel's centre c."""
    return (c[0] - p[0]) * n[0] + (c[1] - p[1]) * n[1] + (c[2] - p[2]) * n[2]


Depth = Callable[[Sequence[float], Sequence[float], Sequence[float], float], float]


def touch(
    ids_in: Mapping[Voxel, Collection[int]],
    points: list[Triple],
    normals: list[Triple],
    center: Triple,
    pose: list[list[float]],
    origin: Triple,
    size: float,
    side: int,
    stiffness: float = 1000.0,
    exclude: Collection[int] = (),
    depth_of: Depth = below_plane,
) -> NaiveTouch:
    """Look every point up in a dictionary of voxels and sum a law, the tangent plane by default."""
    found = NaiveTouch((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), [], [], [])
    total = Total()
    cm = transform(pose, center, shift=True)
    for n, (point, normal) in enumerate(zip(points, normals, strict=True)):
        p = transform(pose, point, shift=True)
        nrm = transform(pose, normal, shift=False)
        voxel = voxel_of(p, origin, size)
        if not all(0 <= v < side for v in voxel):
            continue
        ids = sorted(i for i in ids_in.get(voxel, ()) if i not in exclude)
        if not ids:
            continue
        c = [o + size * (v + 0.5) for o, v in zip(origin, voxel, strict=True)]
        depth = depth_of(p, nrm, c, size)
        found.hits.append(n)
        found.depths.append(max(depth, 0.0))
        found.pairs += [(n, i) for i in ids]
        if depth <= 0:
            continue
        total.add(p, nrm, cm, stiffness, depth)
    found.force, found.torque = total.averaged(float(len(found.hits)))
    return found


def touch_of_shell(
    ids: Mapping[Voxel, Collection[int]],
    grid: Grid,
    shell: PointShell,
    pose: NDArray[np.float64],
    exclude: Collection[int] = (),
    **more: Any,  # noqa: ANN401 - handed on
) -> NaiveTouch:
    """What `touch` says of a shell at a pose (4, 4); more: other arguments of `touch`."""
    return touch(
        ids,
        [(x, y, z) for x, y, z in shell.points.tolist()],
        [(x, y, z) for x, y, z in shell.normals.tolist()],
        (shell.center[0], shell.center[1], shell.center[2]),
        pose.tolist(),
        grid.origin,
        grid.voxel_size,
        grid.side,
        exclude=exclude,
        **more,
    )


class Total:
    """Force and torque, point after point."""

    def __init__(self) -> None:
        self.sums = [0.0] * 6

    def add(
        self, p: Triple, normal: Triple, center: Triple, stiffness: float, depth: float
    ) -> None:
        f = [stiffness * depth * x for x in normal]
        r = [a - b for a, b in zip(p, center, strict=True)]
        self.sums[0] += f[0]
        self.sums[1] += f[1]
        self.sums[2] += f[2]
        self.sums[3] += r[1] * f[2] - r[2] * f[1]
        self.sums[4] += r[2] * f[0] - r[0] * f[2]
        self.sums[5] += r[0] * f[1] - r[1] * f[0]

    def averaged(self, weight: float) -> tuple[Triple, Triple]:
        if weight >= 10:
            self.sums = [x / (weight / 10.0) for x in self.sums]
        fx, fy, fz, tx, ty, tz = self.sums
        return (fx, fy, fz), (tx, ty, tz)


HALF_WIDTH, STEPS, ONSET, BLENDING = 2.75, 254, 1.5, 1.0
Steps = Mapping[Voxel, int]
"""Stored distances of one object at voxel centres; 254 and more, or nothing: far away."""


def distance_at(where: Triple, fields: Collection[Steps]) -> float:
    """u, voxels: the least step of all objects at each of 8 centres, interpolated.

    where : the point in voxels from the grid's origin.
    """
    low = [math.floor(x - 0.5) for x in where]
    part = [x - 0.5 - a for x, a in zip(where, low, strict=True)]

    def corner(i: int, j: int, k: int) -> int:
        at = (low[0] + i, low[1] + j, low[2] + k)
        return min([STEPS, *(steps.get(at, STEPS) for steps in fields)])

    def between(a: float, b: float, share: float) -> float:
        return a + share * (b - a)

    rows = [[between(corner(i, j, 0), corner(i, j, 1), part[2]) for j in (0, 1)] for i in (0, 1)]
    plates = [between(row[0], row[1], part[1]) for row in rows]
    return HALF_WIDTH / STEPS * between(plates[0], plates[1], part[0])


AHEAD, FULL_SLOPE = 0.4, 0.25


def share_at(where: Triple, normal: Triple, fields: Collection[Steps]) -> float:
    """g: how far the inward normal agrees with the distances, 0 to 1."""
    x, y, z = (a + AHEAD * n for a, n in zip(where, normal, strict=True))
    slope = distance_at((x, y, z), fields) - distance_at(where, fields)
    return min(max(slope / (AHEAD * FULL_SLOPE), 0.0), 1.0)


def touch_distances(
    ids_in: Mapping[Voxel, Collection[int]],
    fields: Mapping[int, Steps],
    points: list[Triple],
    normals: list[Triple],
    center: Triple,
    pose: list[list[float]],
    origin: Triple,
    size: float,
    side: int,
    exclude: Collection[int] = (),
) -> NaiveTouch:
    """Sum the distance law; fields has the stored distances of each object."""
    found = NaiveTouch((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), [], [], [])
    total, weight = Total(), 0.0
    cm = transform(pose, center, shift=True)
    felt = {i: steps for i, steps in fields.items() if i not in exclude}
    for n, (point, normal) in enumerate(zip(points, normals, strict=True)):
        p = transform(pose, point, shift=True)
        nrm = transform(pose, normal, shift=False)
        voxel = voxel_of(p, origin, size)
        if not all(0 <= v < side for v in voxel):
            continue
        x, y, z = ((a - o) / size for a, o in zip(p, origin, strict=True))
        u = distance_at((x, y, z), felt.values())
        share = share_at((x, y, z), nrm, felt.values())
        depth = size * (ONSET - u) * share
        weight += min(max((ONSET + BLENDING - u) / BLENDING, 0.0), 1.0) * share
        ids = sorted(i for i in ids_in.get(voxel, ()) if i not in exclude)
        if ids:
            found.hits.append(n)
            found.depths.append(max(depth, 0.0))
            found.pairs += [(n, i) for i in ids]
        if depth > 0:
            if not ids:
                found.apart.append(n)
                found.apart_depths.append(depth)
            own = {i: distance_at((x, y, z), [steps]) for i, steps in felt.items()}
            near = {
                i
                for i, u in own.items()
                if size * (ONSET - u) * share_at((x, y, z), nrm, [felt[i]]) > 0
            }
            near = near or {min(i for i in own if own[i] == min(own.values()))}
            found.near += [(n, i) for i in sorted(near | set(ids))]
            total.add(p, nrm, cm, 1000.0, depth)
    found.force, found.torque = total.averaged(weight)
    return found
