"""Scenes in closed form, as triangles: planes, a cylinder, edges, corners, holes, sheets, plates.

Lengths are in voxels. A scene has axes of its own: x and y along its surface, z away from it; a
rotation turns them into the world. The origin lies on the surface.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Distance = Callable[[Floats], Floats]
"""Distances (N,) from points (N, 3) to a surface, both in voxels, scene's axes; outside only."""

HALF = 30.0
"""Half edge of a plane, voxels. Larger: tools may slide farther, and environments are larger."""
SLOPES = (0.0, 5.0, 20.0, 45.0)
"""Angles of the named planes to the grid, degrees."""
N_RANDOM = 24
"""Planes of random orientation. More: the worst one is found more surely."""
SEED = 14
"""Of all random orientations and places."""
FACETS = 720
"""Faces of a cylinder; they lie within 2e-4 voxels of a cylinder of 20 voxels. More: closer."""
FILLING = (0.0, 0.45, 0.9, 1.35, 1.8, 2.25, 2.7)
"""Depths, voxels, of the sheets of a scene that is solid for the tangent plane: no voxel between
two of them stays free. The plane law has no force where a point has left the one layer of voxels
that a single sheet marks."""


@dataclass(frozen=True)
class Scene:
    """A surface in closed form.

    name : of its own among the scenes of an environment; triangles (T, 3, 3), voxels, about the
    scene's origin, world axes; axes (3, 3): columns x, y, z of the scene in the world; reach:
    distance from the origin, voxels, in which tools may be; distance : exact distances, or None.
    """

    name: str
    triangles: Floats
    axes: Floats
    reach: float
    distance: Distance | None = None


def quad(corners: ArrayLike) -> Floats:
    """Two triangles (2, 3, 3) of a flat figure with corners (4, 3) in order."""
    four = np.asarray(corners, dtype=np.float64)
    return four[[[0, 1, 2], [0, 2, 3]]]


def _scene(
    name: str, triangles: Sequence[Floats], axes: Floats, reach: float, distance: Distance | None
) -> Scene:
    return Scene(name, np.concatenate(list(triangles)) @ axes.T, axes, reach, distance)


def slope_axes(degrees: float) -> Floats:
    """Axes of a plane that rises by an angle along the world's x axis."""
    return np.asarray(Rotation.from_euler("y", -degrees, degrees=True).as_matrix())


def random_axes(count: int, seed: int = SEED) -> Floats:
    """Axes (count, 3, 3) of scenes turned at random."""
    return np.asarray(Rotation.random(count, random_state=seed).as_matrix())


def plane(name: str, axes: Floats, layers: Sequence[float] = (0.0,), half: float = HALF) -> Scene:
    """A square; layers: depths at which it is repeated."""
    x = np.array([-half, half, half, -half])
    y = np.array([-half, -half, half, half])
    found = [quad(np.column_stack([x, y, np.full(4, -depth)])) for depth in layers]
    return _scene(name, found, axes, half, lambda points: np.abs(points[:, 2]))


def planes(layers: Sequence[float] = (0.0,), n_random: int = N_RANDOM) -> list[Scene]:
    """The planes of `SLOPES`, and random ones."""
    named = [plane(f"{slope:g} degrees", slope_axes(slope), layers) for slope in SLOPES]
    turned = random_axes(N_RANDOM)[:n_random]
    return named + [plane(f"random {n + 1}", axes, layers) for n, axes in enumerate(turned)]


def cylinder(
    radius: float, axes: Floats, layers: Sequence[float] = (0.0,), half: float = 20.0
) -> Scene:
    """A cylinder along y, felt from outside; the origin lies on its upper side."""
    angles = np.linspace(0.0, 2.0 * np.pi, FACETS + 1)
    found = []
    for depth in layers:
        ring = np.column_stack(
            [(radius - depth) * np.sin(angles), np.zeros(len(angles)),
             (radius - depth) * np.cos(angles) - radius]
        )  # fmt: skip
        for a, b in pairwise(ring):
            low, high = np.array([0.0, -half, 0.0]), np.array([0.0, half, 0.0])
            found.append(quad([a + low, b + low, b + high, a + high]))

    def distance(points: Floats) -> Floats:
        return np.asarray(np.abs(np.hypot(points[:, 0], points[:, 2] + radius) - radius))

    return _scene(f"cylinder of {radius:g}", found, axes, 2.0 * radius, distance)


def convex_edge(
    axes: Floats, layers: Sequence[float] = (0.0,), half: float = HALF, *, name: str = "convex edge"
) -> Scene:
    """An edge of 90 degrees along y: the solid is where x < 0 and z < 0."""
    found = []
    for depth in layers:
        y = half
        found.append(
            quad(
                [[-half, -y, -depth], [-depth, -y, -depth], [-depth, y, -depth], [-half, y, -depth]]
            )
        )
        found.append(
            quad(
                [[-depth, -y, -half], [-depth, y, -half], [-depth, y, -depth], [-depth, -y, -depth]]
            )
        )

    def distance(points: Floats) -> Floats:
        x, z = points[:, 0], points[:, 2]
        return np.asarray(np.where((x > 0.0) & (z > 0.0), np.hypot(x, z), np.maximum(x, z)))

    return _scene(name, found, axes, half, distance)


def concave_corner(axes: Floats, layers: Sequence[float] = (0.0,), half: float = HALF) -> Scene:
    """A corner of 90 degrees along y: free where x > 0 and z > 0."""
    found = []
    for d in layers:
        y = half
        found.append(quad([[-d, -y, -d], [half, -y, -d], [half, y, -d], [-d, y, -d]]))
        found.append(quad([[-d, -y, -d], [-d, y, -d], [-d, y, half], [-d, -y, half]]))

    def distance(points: Floats) -> Floats:
        return np.asarray(np.minimum(np.abs(points[:, 0]), np.abs(points[:, 2])))

    return _scene("concave corner", found, axes, half, distance)


def hole(width: float, axes: Floats, half: float = 20.0) -> Scene:
    """A square hole along z, of that width; its middle is the origin."""
    w, h = 0.5 * width, half
    corners = [(-w, -w), (w, -w), (w, w), (-w, w)]
    found = []
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        found.append(quad([[ax, ay, -h], [bx, by, -h], [bx, by, h], [ax, ay, h]]))
    return _scene("hole", found, axes, h + 10.0, None)


def round_hole(width: float, axes: Floats, half: float = 20.0) -> Scene:
    """A round hole along z, of that width; its middle is the origin."""
    angles = np.linspace(0.0, 2.0 * np.pi, FACETS + 1)
    ring = 0.5 * width * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    up = np.array([0.0, 0.0, half])
    found = [quad([a - up, b - up, b + up, a + up]) for a, b in pairwise(ring)]
    return _scene("round hole", found, axes, half + 10.0, None)


def plate(name: str, thickness: float, axes: Floats, half: float) -> Scene:
    """A closed square plate about the origin, z across it; a thickness of 0 makes a sheet."""
    t = 0.5 * thickness
    c = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    heights = (-t, t) if t > 0.0 else (0.0,)
    found = [quad(np.column_stack([c, np.full(4, z)])) for z in heights]
    if t > 0.0:
        for a, b in zip(c, np.roll(c, -1, axis=0), strict=True):
            found.append(quad([[*a, -t], [*b, -t], [*b, t], [*a, t]]))
    return _scene(name, found, axes, half, None)
