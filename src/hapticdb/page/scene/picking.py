"""Which object a ray meets first, and where."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.page.scene.shapes import PartShape


@dataclass(frozen=True)
class Struck:
    """An object that a ray meets first.

    Attributes
    ----------
    id : int
        Id of the object.
    point : (3,) float64
        Where the ray meets it, metres, world frame.
    normal : (3,) float64
        Unit normal of its surface there, towards the eye, world frame.
    distance : float
        From the ray's origin, metres.
    """

    id: int
    point: NDArray[np.float64]
    normal: NDArray[np.float64]
    distance: float


@dataclass(frozen=True)
class _Target:
    shape: PartShape | None
    pose: NDArray[np.float64]
    box: NDArray[np.float64]


class Targets:
    """What rays can meet: a shape at a pose for each object, or its box until it has a shape."""

    def __init__(self) -> None:
        self._of: dict[int, _Target] = {}
        self._row: dict[int, int] = {}
        self._ids = np.empty(0, dtype=np.int64)
        self._boxes = np.empty((0, 2, 3))
        self._n = 0

    def put(
        self,
        object_id: int,
        shape: PartShape | None,
        pose: NDArray[np.float64],
        box: NDArray[np.float64],
    ) -> None:
        """Set what rays meet of an object; `box` (2, 3) holds it, metres, world frame."""
        if object_id not in self._row:
            if self._n == len(self._ids):
                self._grow()
            self._row[object_id] = self._n
            self._ids[self._n] = object_id
            self._n += 1
        self._boxes[self._row[object_id]] = box
        self._of[object_id] = _Target(shape, pose, box)

    def remove(self, object_id: int) -> None:
        """Forget an object; the last row takes its place."""
        row = self._row.pop(object_id)
        del self._of[object_id]
        self._n -= 1
        if row != self._n:
            last = int(self._ids[self._n])
            self._ids[row], self._boxes[row] = last, self._boxes[self._n]
            self._row[last] = row

    def _grow(self) -> None:
        room = max(64, 2 * len(self._ids))
        ids, boxes = np.zeros(room, dtype=np.int64), np.zeros((room, 2, 3))
        ids[: self._n], boxes[: self._n] = self._ids[: self._n], self._boxes[: self._n]
        self._ids, self._boxes = ids, boxes

    def first(
        self, origin: ArrayLike, direction: ArrayLike, sees: Callable[[int], bool]
    ) -> Struck | None:
        """The nearest of the objects that `sees` lets pass; None if the ray meets none.

        Objects are tried in the order in which the ray enters their boxes, until the next box lies
        behind the nearest hit.
        """
        start = np.asarray(origin, dtype=np.float64)
        way = np.asarray(direction, dtype=np.float64)
        way = way / np.linalg.norm(way)
        enters, leaves = _slabs(self._boxes[: self._n], start, way)
        met = np.flatnonzero((enters <= leaves) & (leaves >= 0))
        nearest: tuple[float, int, NDArray[np.float64]] | None = None
        for row in met[np.argsort(enters[met])].tolist():
            if nearest is not None and enters[row] > nearest[0]:
                break
            object_id = int(self._ids[row])
            if not sees(object_id):
                continue
            found = _met(self._of[object_id], start, way, float(enters[row]))
            if found is not None and (nearest is None or found[0] < nearest[0]):
                nearest = (found[0], object_id, found[1])
        if nearest is None:
            return None
        distance, object_id, normal = nearest
        facing = -normal if normal @ way > 0 else normal
        return Struck(object_id, start + distance * way, facing, distance)


def _slabs(
    boxes: NDArray[np.float64], start: NDArray[np.float64], way: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances at which a ray enters and leaves each box (n, 2, 3), which is a little enlarged."""
    room = 1e-9 * (np.abs(boxes).max(axis=(1, 2)) + np.abs(start).max())
    with np.errstate(divide="ignore", invalid="ignore"):
        one = (boxes[:, 0] - room[:, None] - start) / way
        other = (boxes[:, 1] + room[:, None] - start) / way
    enters = np.fmax.reduce(np.fmin(one, other), axis=1)
    leaves = np.fmin.reduce(np.fmax(one, other), axis=1)
    return np.maximum(enters, 0.0), leaves


def _met(
    target: _Target, start: NDArray[np.float64], way: NDArray[np.float64], enters: float
) -> tuple[float, NDArray[np.float64]] | None:
    """Distance to an object and the normal there (3,); None if the ray misses it."""
    if target.shape is None:
        point = start + enters * way
        off = (point - target.box.mean(axis=0)) / np.maximum(np.ptp(target.box, axis=0), 1e-12)
        axis = int(np.argmax(np.abs(off)))
        return enters, np.sign(off[axis]) * np.eye(3)[axis]
    turn = target.pose[:3, :3]
    hit = target.shape.first_hit(turn.T @ (start - target.pose[:3, 3]), turn.T @ way)
    if hit is None:
        return None
    return hit.distance, turn @ target.shape.normal(hit.face)
