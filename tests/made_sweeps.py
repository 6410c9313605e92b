"""Results of sweeps that are made by hand, for tests of what tells and draws them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb import Object
from hapticdb.exact.path import ToolPath
from hapticdb.exact.swept import Gap, PathPlace, Swept, TouchedObject

Floats = NDArray[np.float64]

CORNERS = 0.01 * np.array(
    [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
)
"""Of the tool, a cube of 2 cm."""


def thing(name: str, number: int = 1, side: float = 0.1) -> Object:
    """An object about the origin."""
    half = np.full(3, 0.5 * side)
    return Object(name, "a.glb", "", np.eye(4), 1, np.stack([-half, half]), id=number)


def place_at(found: Object, fraction: float, path: ToolPath, apart: float = 0.0) -> PathPlace:
    """Where the tool is at a share of the path; apart : metres between the two surfaces."""
    way = np.array([fraction * path.length])
    pose = path.at(way)[0]
    on_tool = pose[:3, 3] - (0.0, 0.0, 0.01)
    on_object = on_tool - (0.0, 0.0, apart)
    return PathPlace(found, fraction, int(path.segments(way)[0]), pose, on_tool, on_object)


def line(*places: tuple[float, float, float]) -> ToolPath:
    """A path of the tool through places; 1 m along x unless they are given."""
    places = places or ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return ToolPath.of(poses, CORNERS, np.zeros(3))


def touching(found: Object, until: float, **changed: Any) -> TouchedObject:  # noqa: ANN401 - its fields
    """An object that the tool touches without overlap."""
    one = TouchedObject(found, 5e-5, 0.0, 7e-5, until, "shift", is_sliding=False)
    return one._replace(**changed)


def swept(path: ToolPath | None = None, **changed: Any) -> Swept:  # noqa: ANN401 - fields of a result
    """A sweep that meets nothing, with some fields changed."""
    path = path or line()
    fields: dict[str, Any] = {
        "path": path,
        "gap": Gap(np.inf, np.inf, None),
        "hits": (),
        "touching": (),
        "enclosed": (),
        "undecided": (),
        "leaky": (),
        "contact": 5e-5,
        "overlap": 0.0,
        "objects": 3,
        "queries": 40,
        "revision": 1,
        "elapsed": 0.1,
    }
    return Swept(**(fields | changed))
