"""Shapes of objects, each built once for all objects that place it, as long as memory lasts."""

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from hapticdb.ingest.geometry import unpacked_part
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.store.base import Object, Store

Floats = NDArray[np.float64]

RIGID = 1e-12
"""Greatest deviation of a rotation's columns from orthonormal ones. Other placements get a shape of
their own."""
BYTES_OF_CORNERS = 6
"""Bytes of a shape for each byte of its corners, with all that is built from them."""


class Shapes:
    """The shapes of an environment's objects, those used last kept within `budget` bytes."""

    def __init__(self, store: Store, budget: int) -> None:
        self._store, self._budget = store, budget
        self._kept: OrderedDict[tuple[str, bytes], CollisionShape] = OrderedDict()
        self._bytes = 0
        self._placements: dict[int, tuple[tuple[str, bytes], Floats]] = {}

    def shape(self, obj: Object) -> CollisionShape | None:
        """Shape of an object; None if it was written meanwhile."""
        key, _ = self.placement(obj)
        shape = self._kept.get(key)
        if shape is None:
            shape = self._read(obj, np.frombuffer(key[1]).reshape(3, 3))
            if shape is None:
                return None
            self._kept[key] = shape
            self._bytes += _bytes_of(shape)
            # two stay, whatever their size: a pair needs both
            while self._bytes > self._budget and len(self._kept) > 2:
                self._bytes -= _bytes_of(self._kept.popitem(last=False)[1])
        self._kept.move_to_end(key)
        return shape

    def placement(self, obj: Object) -> tuple[tuple[str, bytes], Floats]:
        """Key of an object's shape, equal for equal ones, and its rigid placement (4, 4)."""
        if obj.id not in self._placements:
            linear, pose = _rigid_placement(obj.transform)
            self._placements[obj.id] = (obj.digest, linear.tobytes()), pose
        return self._placements[obj.id]

    def _read(self, obj: Object, linear: Floats) -> CollisionShape | None:
        packed = self._store.surfaces([obj.digest]).get(obj.digest)
        # gone, or written meanwhile with another digest; else it is damage, reported below
        if packed is None and all(
            now.digest != obj.digest for now in self._store.objects([obj.id])
        ):
            return None
        part = unpacked_part(self._store.url, obj, packed)
        corners = part.vertices @ linear.T
        if part.faces is None:
            # a point is a triangle of three equal corners
            return CollisionShape(np.repeat(corners[:, None], 3, axis=1), is_cloud=True)
        return CollisionShape(corners[part.faces], chord=part.placed_chord, index=part.faces)


def _bytes_of(shape: CollisionShape) -> int:
    return BYTES_OF_CORNERS * int(shape.tree.corners.nbytes)


def _rigid_placement(transform: Floats) -> tuple[Floats, Floats]:
    """A linear map (3, 3) to be built into the shape, and the rigid placement of the result."""
    linear, pose = transform[:3, :3], np.eye(4)
    pose[:3, 3] = transform[:3, 3]
    # negative for a mirror: the rest is a proper rotation
    scale = float(np.cbrt(np.linalg.det(linear)))
    if scale != 0.0:
        # exactly 1 or -1 within rounding: equal keys, so that copies share a shape
        scale = float(np.sign(scale)) if abs(abs(scale) - 1.0) < RIGID else scale
        rotation = linear / scale
        if np.abs(rotation.T @ rotation - np.eye(3)).max() < RIGID:
            pose[:3, :3] = rotation
            return scale * np.eye(3), pose
    return linear, pose


def relative_poses(world_from_a: Floats, world_from_b: Floats) -> Floats:
    """Poses (P, 4, 4) of b in the frames of a, of rigid ones (P, 4, 4)."""
    back = np.zeros_like(world_from_a)
    back[:, 3, 3] = 1.0
    back[:, :3, :3] = world_from_a[:, :3, :3].transpose(0, 2, 1)
    back[:, :3, 3:] = -back[:, :3, :3] @ world_from_a[:, :3, 3:]
    return np.asarray(back @ world_from_b)
