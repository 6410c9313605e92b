"""Pulls drawn at random that start in contact; what is true of each is known as it is made."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from contact_scenes import (
    CONTACT,
    Floats,
    ball,
    box,
    grid,
    hollow,
    inverted,
    joined,
    pulls,
    ring,
    rod,
    rotated,
    sheet,
)

Random = np.random.Generator
Truth = str
"""What must come out: "free", "not hit" (an overlap at the start may be told), "hit", or "open".

Sunk by less than the tolerance, what never moves down is free. Sunk deeper, this is known of
straight lifts alone: an overlap at the rim grows sideways.
"""


class Body(NamedTuple):
    """A surface; solid : its closed part, each body once; thin : least height of a piece."""

    triangles: Floats
    solid: Floats
    thin: float

    def shifted(self, by: Floats) -> "Body":
        return Body(self.triangles + by, self.solid + by, self.thin)

    def within(self, size: float) -> "Body":
        """The same, made smaller if it is wider."""
        scale = min(1.0, size / np.ptp(self.triangles, axis=(0, 1)).max())
        return Body(self.triangles * scale, self.solid * scale, self.thin * scale)

    @property
    def height(self) -> tuple[float, float]:
        return float(self.triangles[..., 2].min()), float(self.triangles[..., 2].max())


class RandomPull(NamedTuple):
    """A pull; radius : of a ball tool at `middle`, else 0; sunk : overlap at the start, or -gap."""

    kind: str
    tool: Body
    objects: tuple[Body, ...]
    poses: Floats
    seated: bool
    sunk: float
    truth: Truth
    radius: float = 0.0
    middle: Floats = np.zeros(3)


NONE = np.zeros((0, 3, 3))


def _closed(triangles: Floats) -> Body:
    return Body(triangles, triangles, float(np.ptp(triangles[..., 2])))


def _open(triangles: Floats) -> Body:
    return Body(triangles, NONE, float(np.ptp(triangles[..., 2])))


def _log(rng: Random, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _block(rng: Random) -> Body:
    return _closed(box((_log(rng, 2, 20), _log(rng, 2, 20), _log(rng, 1, 10))))


def _plate(rng: Random) -> Body:
    return _closed(box((_log(rng, 4, 20), _log(rng, 4, 20), _log(rng, 0.05, 1))))


def _blade(rng: Random) -> Body:
    """A plate or foil that stands on its edge."""
    return _closed(rotated(_plate(rng).triangles, 90.0, "x"))


def _wire(rng: Random) -> Body:
    made = rod(_log(rng, 0.03, 0.2), _log(rng, 4, 20), 8)
    return _closed(made if rng.random() < 0.6 else rotated(made, 90.0, "y"))


def _pin(rng: Random) -> Body:
    made = rod(_log(rng, 0.5, 4), _log(rng, 2, 15), int(rng.integers(6, 25)))
    return _closed(made if rng.random() < 0.6 else rotated(made, 90.0, "y"))


def _mesh_ball(rng: Random) -> Body:
    return _closed(ball(_log(rng, 0.5, 5), (0, 0, 0), 2))


def _washer(rng: Random) -> Body:
    inner = _log(rng, 1, 4)
    return _closed(ring(inner, inner + _log(rng, 0.5, 6), _log(rng, 0.1, 5), 24))


def _flat_sheet(rng: Random) -> Body:
    side = _log(rng, 4, 20)
    return _open(sheet(side) if rng.random() < 0.5 else grid("z", side, int(rng.integers(2, 9))))


def _standing_sheet(rng: Random) -> Body:
    return _open(grid("x", _log(rng, 4, 20), int(rng.integers(1, 9))))


def _tray(rng: Random) -> Body:
    """A box that lacks its upper side."""
    made = _block(rng).triangles
    return _open(made[(made[..., 2] < made[..., 2].max()).any(axis=1)])


def _angle_iron(rng: Random) -> Body:
    """Two plates that meet flush: one lies, one stands."""
    a, b, t = _log(rng, 4, 15), _log(rng, 4, 15), _log(rng, 0.1, 2)
    lying, standing = box((a, b, t), (0, 0, 0.5 * t)), box((t, b, a), (0.5 * (a - t), 0, t + a / 2))
    return Body(joined(lying, standing), joined(lying, standing), t)


def _case(rng: Random) -> Body:
    outer = _log(rng, 5, 20)
    return _closed(hollow(outer, 0.8 * outer))


def _splinter(rng: Random) -> Body:
    return _closed(np.asarray(trimesh.PointCloud(rng.normal(0, 4, (7, 3))).convex_hull.triangles))


SHAPES: tuple[Callable[[Random], Body], ...] = (
    _block, _plate, _blade, _wire, _pin, _mesh_ball, _washer, _flat_sheet, _standing_sheet, _tray,
    _angle_iron, _case, _splinter,
)  # fmt: skip
GROUND = (_block, _plate, _plate, _flat_sheet, _tray, _case, _washer, _angle_iron, _pin)
"""Shapes that objects have; thin and flat ones more often."""


def _shape(rng: Random, shapes: tuple[Callable[[Random], Body], ...], *, tilted: float) -> Body:
    """One of the shapes as files hold them: inside out, twice, or tilted, too."""
    made = shapes[int(rng.integers(len(shapes)))](rng)
    if rng.random() < tilted:
        turn = Rotation.random(rng=rng).as_matrix()
        turned = made.triangles @ turn.T
        made = Body(turned, made.solid @ turn.T, min(made.thin, float(np.ptp(turned[..., 2]))))
    if rng.random() < 0.15:
        made = Body(inverted(made.triangles), inverted(made.solid), made.thin)
    if rng.random() < 0.1:
        made = made._replace(triangles=joined(made.triangles, made.triangles))
    return made


def _direction(rng: Random) -> tuple[Floats, str]:
    """Unit vector of a pull, and how it leads: off the plane, along it, into it."""
    kind = str(rng.choice(["off", "along", "into", "straight in", "straight off"]))
    way = rng.normal(size=3)
    way[2] = {"off": abs(way[2]), "along": 0.0, "into": -abs(way[2])}.get(kind, 0.0)
    if kind.startswith("straight"):
        way = np.array([0.0, 0.0, -1.0 if kind == "straight in" else 1.0])
    return way / np.linalg.norm(way), kind


def _path(rng: Random) -> tuple[Floats, bool]:
    """Displacements, and whether they never lead below the plane: no turn, no step down."""
    way, kind = _direction(rng)
    poses = pulls(tuple(_log(rng, 0.1, 25) * way))
    if rng.random() < 0.2:
        more, second = _direction(rng)
        to = poses[1, :3, 3] + _log(rng, 0.1, 25) * more
        poses = pulls(tuple(poses[1, :3, 3]), tuple(to))
        kind = kind if second in {"off", "along", "straight off"} else second
    if rng.random() < 0.12:
        poses[-1, :3, :3] = Rotation.from_rotvec(rng.normal(size=3) * 0.5).as_matrix()
        if rng.random() < 0.3:
            poses[-1, :3, 3] = 0.0
        return poses, False
    return poses, kind in {"off", "along", "straight off"}


def _start(rng: Random) -> float:
    """How deep the tool is sunk where it starts; below 0 a gap."""
    kind = rng.integers(5)
    if kind == 0:
        return 0.0
    if kind == 1:
        return -_log(rng, 0.002, 0.045)
    if kind == 2:
        return _log(rng, 0.001, 0.045)
    return _log(rng, 0.1, 3.0) if kind == 3 else -0.002


def _rests(rng: Random) -> RandomPull:
    """A tool on a plane under which one or two objects lie."""
    tool = _shape(rng, SHAPES, tilted=0.25)
    if rng.random() < 0.15:  # a part of two bodies
        other = _shape(rng, SHAPES, tilted=0.25)
        aside = np.array([tool.triangles[..., 0].max() - other.triangles[..., 0].min() + 1.0, 0, 0])
        aside[2] = tool.height[0] - other.height[0]
        other = other.shifted(aside)
        both = joined(tool.triangles, other.triangles), joined(tool.solid, other.solid)
        tool = Body(*both, min(tool.thin, other.thin))
    radius, middle = 0.0, np.zeros(3)
    if rng.random() < 0.12:
        radius = _log(rng, 0.5, 6)
        tool = _closed(ball(radius, (0, 0, 0), 2))
        tool = tool._replace(thin=2.0 * radius)
    objects = [_shape(rng, GROUND, tilted=0.1)]
    if rng.random() < 0.25:
        objects.append(_shape(rng, GROUND, tilted=0.0))
    thin = min(tool.thin, *(one.thin for one in objects))
    sunk = _start(rng)
    sunk = min(sunk, 0.4 * thin) if thin > 0.01 else min(sunk, 0.0)
    low = -radius if radius else tool.height[0]
    up = np.array([*rng.uniform(-2, 2, 2), -low - sunk])
    tool, middle = tool.shifted(up), middle + up
    lying = []
    for n, one in enumerate(objects):
        at = np.array([9.0 * n, 0.0, -one.height[1]])
        lying.append(one.shifted(at - [one.triangles[..., 0].min() + 4.0 if n else 0.0, 0, 0]))
    poses, is_off = _path(rng)
    truth = "open"
    if is_off and sunk <= CONTACT - 0.005:
        truth = "free"
    elif (
        is_off
        and not poses[:, :2, 3].any()
        and sunk < 0.25 * min(_second(tool), *(_second(one) for one in lying))
    ):
        truth = "not hit"
    seated = truth == "not hit" or rng.random() < 0.6
    return RandomPull("rests", tool, tuple(lying), poses, seated, sunk, truth, radius, middle)


def _second(body: Body) -> float:
    return float(np.sort(np.ptp(body.triangles, axis=(0, 1)))[1])


def _fits(rng: Random) -> RandomPull:
    """A peg in its bore, along the axis or not; coarse in fine, of equal meshes, pressed in."""
    radius, n = _log(rng, 1, 8), int(rng.integers(8, 40))
    length = _log(rng, 3, 20)
    sunk = float(rng.choice([0.0, -0.002, 0.01, -_log(rng, 0.002, 0.045)]))
    peg = rod(radius + sunk, length * rng.uniform(0.8, 1.5), n)
    # finer by a whole factor: the peg's corners are where corners of the bore are
    times = 1 if rng.random() < 0.5 else 3
    bore = ring(radius, radius + _log(rng, 0.3, 6), length, times * n)
    poses, is_along = _path(rng), rng.random() < 0.5
    if is_along:
        ends = rng.choice([-2.0, 2.0]) * length * np.cumsum(rng.random(int(rng.integers(1, 3))))
        return RandomPull(
            "fits", _closed(peg), (_closed(bore),), pulls(*((0.0, 0.0, float(z)) for z in ends)),
            rng.random() < 0.6, sunk, "free",
        )  # fmt: skip
    return RandomPull("fits", _closed(peg), (_closed(bore),), poses[0], True, sunk, "open")


def _in_tin(rng: Random) -> RandomPull:
    """A thing on the floor of a closed tin of 18 inside; it never gets out."""
    tool = _shape(rng, SHAPES, tilted=0.3).within(6.0)
    sunk = -float(rng.choice([0.002, 0.01, 0.03]))
    tool = tool.shifted(np.array([0.0, 0.0, -9.0 - tool.height[0] - sunk]))
    thick = _log(rng, 0.05, 3)
    tin = _closed(hollow(18.0 + 2.0 * thick, 18.0))
    way = rng.normal(size=3)
    way *= _log(rng, 40, 60) / np.abs(way).max()
    poses = pulls(tuple(way)) if rng.random() < 0.7 else pulls((0, 0, 3.0), tuple(way))
    return RandomPull("in tin", tool, (tin,), poses, rng.random() < 0.5, sunk, "hit")


def _buried(rng: Random) -> RandomPull:
    """A thing within a block, near its face or far from it: a hit wherever it goes."""
    tool = _shape(rng, SHAPES, tilted=0.5).within(8.0)
    deep = float(rng.choice([0.002, 0.02, 0.045, 0.5, 3.0]))
    tool = tool.shifted(np.array([0.0, 0.0, -deep - tool.height[1]]))
    block = _closed(box((30, 30, 30), (0, 0, -15)))
    return RandomPull("buried", tool, (block,), _path(rng)[0], rng.random() < 0.5, deep, "hit")


KINDS = (_rests, _rests, _rests, _rests, _rests, _rests, _fits, _fits, _in_tin, _buried)


def random_pull(seed: int) -> RandomPull:
    return KINDS[seed % len(KINDS)](np.random.default_rng([46, seed]))
