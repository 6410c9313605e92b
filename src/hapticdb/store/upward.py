"""Which axis of a scene points up."""

from collections.abc import Iterable

import numpy as np

from hapticdb.store.base import Object

AXES = ("x", "y", "z")


def up_axis(objects: Iterable[Object]) -> int:
    """Axis that points up in a scene, 0 to 2: that of most voxels; z for files that name none."""
    votes = np.zeros(3)
    for obj in objects:
        said = obj.attributes.get("up")
        votes["xyz".find(said) if isinstance(said, str) and said in AXES else 2] += obj.voxels
    return 2 - int(np.argmax(votes[::-1]))
