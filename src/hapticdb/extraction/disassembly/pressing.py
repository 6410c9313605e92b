"""Whether a path presses against what the parts touch at its start.

A part that only leaves contact slides along surfaces, or away from them. Voxels do not tell that
from cutting through a thin flange or a bolt's head: the contacts' normals do.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.extraction.directions import AGAINST
from hapticdb.extraction.result import Extraction
from hapticdb.store.base import Object

PRESSED = 0.2
"""Share of the contacts with one object that may press against it. Larger: parts are taken off
that cut through what holds them; smaller: rough surfaces count as obstacles."""


def pressed_objects(
    env: Environment, found: Extraction, exclude: tuple[int, ...]
) -> tuple[Object, ...]:
    """Objects that the first motion of a found path presses against, ordered by id.

    exclude : ids of what is not felt, the parts among them.
    """
    assert found.way is not None  # noqa: S101 - there is a path
    if len(found.way.poses) < 2:
        return ()
    touched = env.touch(found.shell, np.eye(4), exclude=exclude, law="plane")
    points = found.shell.points[touched.contacts]
    against = opposed(points, touched.contact_normals, found.way.poses[1])
    pairs = touched.contact_pairs
    is_against = np.isin(pairs[:, 0], touched.contacts[against])
    pressed = []
    for obj in touched.objects:
        mine = is_against[pairs[:, 1] == obj.id]
        if len(mine) and mine.mean() > PRESSED:
            pressed.append(obj)
    return tuple(pressed)


def opposed(
    points: NDArray[np.float64], normals: NDArray[np.float64], pose: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether contacts (C, 3) with unit normals (C, 3) into the part press as it moves to a pose.

    pose (4, 4) : displacement; a contact presses if it moves more than 12 degrees into what it
    touches.
    """
    moves = points @ (pose[:3, :3] - np.eye(3)).T + pose[:3, 3]
    lengths = np.linalg.norm(moves, axis=1)
    return np.asarray((moves * normals).sum(axis=1) < AGAINST * lengths)
