"""Surroundings of the objects: vertical axis, ground, light, background, first view."""

from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from viser import SceneApi, ViserServer

from hapticdb.poses import quaternion_of

Plane = Literal["yz", "zx", "xy"]
PLANES: tuple[Plane, ...] = get_args(Plane)
"""Plane of the ground, by the number of the vertical axis."""
FIELD_OF_VIEW = 0.7
"""Vertical field of view, radians. Larger: more perspective distortion."""
TOWARDS = (0.62, 0.50, 0.42)
"""Direction from the objects to the first eye: along the two axes of the ground, and up."""
ABOVE = (226, 231, 237)
BELOW = (250, 251, 252)
"""Colours of the background, at the top and at the bottom of the picture."""
SHADOW_EDGE = 3.0
"""Edge of the shadow's image, in radii of the scene."""
SHADOW_PIXELS = 192
"""Pixels along that edge."""


class View(NamedTuple):
    """Eye and target of a camera: positions (3,), metres, world frame."""

    position: NDArray[np.float64]
    look_at: NDArray[np.float64]


def framing(box: NDArray[np.float64], up: int, reach: float = 0.0) -> View:
    """View of an AABB (2, 3) and of a sphere of radius `reach` about its centre, metres."""
    center = box.mean(axis=0)
    radius = max(float(np.linalg.norm(box[1] - box[0])) / 2, reach, 1e-9)
    toward = np.zeros(3)
    toward[[(up + 1) % 3, (up + 2) % 3, up]] = TOWARDS
    toward /= np.linalg.norm(toward)
    # at this distance the sphere touches the cone of the field of view
    return View(center + toward * radius / np.sin(FIELD_OF_VIEW / 2), center)


def add_surroundings(server: ViserServer, box: NDArray[np.float64], up: int) -> None:
    """Add light, background, ground and first view for objects in an AABB (2, 3), metres."""
    scene = server.scene
    scene.set_up_direction(tuple(np.eye(3)[up]))
    scene.configure_default_lights(enabled=True, cast_shadow=False)
    scene.add_light_ambient("/light", intensity=0.5)
    scene.configure_environment_map(None)  # with one, 20 times slower without a GPU
    steps = np.linspace(0.0, 1.0, 64)[:, None, None]
    shades = (1 - steps) * np.array(ABOVE) + steps * np.array(BELOW)
    scene.set_background_image(np.tile(shades.astype(np.uint8), (1, 8, 1)), format="png")
    _set_ground(scene, box, up)
    set_first_view(server, box, up, 0.0)


def set_first_view(server: ViserServer, box: NDArray[np.float64], up: int, reach: float) -> None:
    """Set the initial camera of browsers to the view of `framing`."""
    view, camera = framing(box, up, reach), server.initial_camera
    radius = float(np.linalg.norm(view.position - view.look_at)) * np.sin(FIELD_OF_VIEW / 2)
    camera.fov = FIELD_OF_VIEW
    camera.near, camera.far = radius / 200, radius * 100
    camera.up = tuple(np.eye(3)[up])
    camera.look_at = tuple(view.look_at)
    camera.position = tuple(view.position)


def _set_ground(scene: SceneApi, box: NDArray[np.float64], up: int) -> None:
    """Lines below the objects, a power of ten metres apart."""
    radius = max(float(np.linalg.norm(box[1] - box[0])) / 2, 1e-9)
    spacing = 10.0 ** np.floor(np.log10(radius / 2))
    center = box.mean(axis=0)
    # snapped to the tenth lines, which are then at round coordinates
    center = np.round(center / (10 * spacing)) * 10 * spacing
    center[up] = box[0, up]
    edge = float(np.ceil(4.0 * radius / spacing) * spacing)
    scene.add_grid(
        "/ground", edge, edge, plane=PLANES[up], cell_size=float(spacing),
        section_size=float(10 * spacing), cell_color=(196, 202, 210),
        section_color=(168, 176, 187), cell_thickness=0.7, section_thickness=1.0,
        fade_distance=6 * radius, fade_from="camera", position=tuple(center),
    )  # fmt: skip


def add_shadow(scene: SceneApi, boxes: NDArray[np.float64], up: int, ground: float) -> None:
    """Replace the soft shadow by that of AABBs (n, 2, 3), metres: an image, free to render.

    ground : its height, metres.
    """
    if not len(boxes):
        scene.remove_by_name("/shadow")
        return
    axes = [(up + 1) % 3, (up + 2) % 3]
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    edge = SHADOW_EDGE * radius
    first = (low + high)[axes] / 2 - edge / 2
    cells = np.floor((boxes[:, :, axes] - first) / edge * SHADOW_PIXELS).astype(np.int64)
    cells = np.clip(cells, 0, SHADOW_PIXELS - 1)
    covered = np.zeros((SHADOW_PIXELS, SHADOW_PIXELS))
    for (left, near), (right, far) in cells.tolist():
        covered[near : far + 1, left : right + 1] = 1.0
    sigma = 0.05 * SHADOW_PIXELS / SHADOW_EDGE  # 0.05 radii
    image = np.zeros((SHADOW_PIXELS, SHADOW_PIXELS, 4), dtype=np.uint8)
    image[..., 3] = np.round(255 * 0.45 * gaussian_filter(covered, sigma))
    place = (low + high) / 2
    place[up] = ground - 1e-3 * radius
    turn = np.eye(3)[[*axes, up]].T
    scene.add_image(
        "/shadow", image, edge, edge, format="png", cast_shadow=False, receive_shadow=False,
        wxyz=quaternion_of(turn[None])[0], position=tuple(place),
    )  # fmt: skip
