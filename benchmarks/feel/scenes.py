"""Scenes in closed form, as triangles: planes, edges, corners.

Lengths are in voxels. A scene has axes of its own: x and y along its surface, z away from it; a
rotation turns them into the world. The origin lies on the surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

HALF = 30.0
"""Half edge of a plane, voxels. Larger: tools may slide farther, and environments are larger."""
SLOPES = (0.0, 5.0, 20.0, 45.0)
"""Angles of the named planes to the grid, degrees."""
N_RANDOM = 24
"""Planes of random orientation. More: the worst one is found more surely."""
SEED = 14
"""Of all random orientations and places."""
FILLING = (0.0, 0.45, 0.9, 1.35, 1.8, 2.25, 2.7)
"""Depths, voxels, of the sheets of a scene that is solid for the tangent plane: no voxel between
two of them stays free. The plane law has no force where a point has left the one layer of voxels
that a single sheet marks."""


@dataclass(frozen=True)
class Scene:
    """A surface in closed form.

    name : of its own among the scenes of an environment; triangles (T, 3, 3), voxels, about the
    scene's origin, world axes; axes (3, 3): columns x, y, z of the scene in the world; reach:
    distance from the origin, voxels, in which tools may be.
    """

    name: str
    triangles: Floats
    axes: Floats
    reach: float


def quad(corners: ArrayLike) -> Floats:
    """Two triangles (2, 3, 3) of a flat figure with corners (4, 3) in order."""
    four = np.asarray(corners, dtype=np.float64)
    return four[[[0, 1, 2], [0, 2, 3]]]


def _scene(name: str, triangles: Sequence[Floats], axes: Floats, reach: float) -> Scene:
    return Scene(name, np.concatenate(list(triangles)) @ axes.T, axes, reach)


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
    return _scene(name, found, axes, half)


def planes(layers: Sequence[float] = (0.0,), n_random: int = N_RANDOM) -> list[Scene]:
    """The planes of `SLOPES`, and random ones."""
    named = [plane(f"{slope:g} degrees", slope_axes(slope), layers) for slope in SLOPES]
    turned = random_axes(N_RANDOM)[:n_random]
    return named + [plane(f"random {n + 1}", axes, layers) for n, axes in enumerate(turned)]


def convex_edge(axes: Floats) -> Scene:
    """An edge of 90 degrees along y: the solid is where x < 0 and z < 0."""
    h = HALF
    found = [
        quad([[-h, -h, 0.0], [0.0, -h, 0.0], [0.0, h, 0.0], [-h, h, 0.0]]),
        quad([[0.0, -h, -h], [0.0, h, -h], [0.0, h, 0.0], [0.0, -h, 0.0]]),
    ]
    return _scene("convex edge", found, axes, h)
