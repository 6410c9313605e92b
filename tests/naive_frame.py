"""One frame in plain Python, slow and obviously right: the oracle of every strategy.

Sums and products are in the order that hapticdb promises, so the wrench is the same bit for bit.
The hits come from a plain set.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

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

    @property
    def contacts(self) -> list[int]:
        return [h for h, d in zip(self.hits, self.depths, strict=True) if d > 0]

    @property
    def ids(self) -> list[int]:
        return sorted({i for _, i in self.pairs})


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
    total = [0.0] * 6
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
        f = [stiffness * depth * x for x in nrm]
        r = [a - b for a, b in zip(p, cm, strict=True)]
        total[0] += f[0]
        total[1] += f[1]
        total[2] += f[2]
        total[3] += r[1] * f[2] - r[2] * f[1]
        total[4] += r[2] * f[0] - r[0] * f[2]
        total[5] += r[0] * f[1] - r[1] * f[0]
    if len(found.hits) >= 10:
        total = [x / (len(found.hits) / 10.0) for x in total]
    found.force = (total[0], total[1], total[2])
    found.torque = (total[3], total[4], total[5])
    return found
