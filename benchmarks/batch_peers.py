"""Peers that answer many poses of a tool: whether it touches the car, and how far it is from it.

Each has all of the car's triangles in memory. python-fcl and coal compare them with the tool's
triangles, a pose at a time: with one tree of boxes around all of the car, and with a tree for each
part; the other way round each was slower at 300 and 100,000 points in all situations. Open3D takes
the triangle nearest to each of the shell's points.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mesh = tuple[Floats, NDArray[np.int64]]
"""Vertices (V, 3), metres, and faces (F, 3)."""
MM = 1e3
"""python-fcl and coal are asked in millimetres: in metres they are wrong for small triangles."""
POINTS_AT_ONCE = 1 << 20
"""Points in one question to Open3D."""
INSTALL = "not measured: pip install --no-deps -r requirements/figures.txt"


class PeerMissingError(Exception):
    """A peer's package is not installed."""


def _loaded(name: str) -> Any:  # noqa: ANN401 - modules without types
    try:
        return __import__(name)
    except (ImportError, OSError) as error:
        raise PeerMissingError(INSTALL) from error


def mesh_of(triangles: Floats) -> Mesh:
    """Vertices and faces of corners (T, 3, 3)."""
    return triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)


class BatchPeer:
    """Another program that answers poses (B, 4, 4), world_from_tool, on its own.

    Its subclasses answer one pose, or all of them. Parameters: corners (T, 3, 3) of each part, and
    the tool, metres. Raises PeerMissingError if its package is not installed. A distance is in
    metres, 0 or less where the tool touches.
    """

    name: str

    def __init__(self, parts: Sequence[Floats], tool: Mesh) -> None:
        raise NotImplementedError

    def touches_at(self, pose: Floats) -> bool:
        raise NotImplementedError

    def distance_at(self, pose: Floats) -> float:
        raise NotImplementedError

    def touches(self, points: Floats, poses: Floats) -> NDArray[np.bool_]:  # noqa: ARG002
        """Whether the tool, with shell points (N, 3), touches, (B,)."""
        return np.array([self.touches_at(pose) for pose in poses], dtype=np.bool_)

    def distances(self, points: Floats, poses: Floats) -> Floats:  # noqa: ARG002
        return np.array([self.distance_at(pose) for pose in poses])


class FclBatch(BatchPeer):
    """python-fcl: mesh against mesh, in trees of boxes around the triangles of both."""

    name = "python-fcl"

    def __init__(self, parts: Sequence[Floats], tool: Mesh) -> None:
        self._fcl = _loaded("fcl")
        self._tool = self._object(*tool)
        self._car = self._object(*mesh_of(np.concatenate(parts)))
        self._collision = self._fcl.CollisionRequest(num_max_contacts=1)
        self._distance = self._fcl.DistanceRequest()

    def _object(self, vertices: Floats, faces: NDArray[np.int64]) -> Any:  # noqa: ANN401
        """A tree of boxes around triangles, at rest."""
        model = self._fcl.BVHModel()
        model.beginModel(len(faces), len(vertices))
        model.addSubModel(MM * vertices, faces)
        model.endModel()
        return self._fcl.CollisionObject(model, self._fcl.Transform())

    def _move(self, pose: Floats) -> None:
        self._tool.setTransform(self._fcl.Transform(pose[:3, :3], MM * pose[:3, 3]))

    def touches_at(self, pose: Floats) -> bool:
        self._move(pose)
        result = self._fcl.CollisionResult()
        return bool(self._fcl.collide(self._car, self._tool, self._collision, result) > 0)

    def distance_at(self, pose: Floats) -> float:
        self._move(pose)
        result = self._fcl.DistanceResult()
        return float(self._fcl.distance(self._car, self._tool, self._distance, result)) / MM


def tree_of_boxes(vertices: Floats, faces: NDArray[np.int64]) -> Any:  # noqa: ANN401 - no types
    """coal's tree of boxes around triangles."""
    model = _loaded("coal").BVHModelOBBRSS()
    model.beginModel(len(faces), len(vertices))
    model.addVertices(np.ascontiguousarray(vertices))
    model.addTriangles(np.ascontiguousarray(faces, dtype=np.int64))
    model.endModel()
    return model


class CoalBatch(BatchPeer):
    """coal, a newer python-fcl, with a tree of boxes for each part, below a tree of the parts."""

    name = "coal, parts"

    def __init__(self, parts: Sequence[Floats], tool: Mesh) -> None:
        self._coal = coal = _loaded("coal")
        self._all = [coal.CollisionObject(tree_of_boxes(*mesh_of(MM * part))) for part in parts]
        self._parts = coal.DynamicAABBTreeCollisionManager()
        for part in self._all:
            self._parts.registerObject(part)
        self._parts.setup()
        self._tool = coal.CollisionObject(tree_of_boxes(MM * tool[0], tool[1]))

    def _asked(self, pose: Floats, asked: Any) -> Any:  # noqa: ANN401
        self._tool.setTransform(self._coal.Transform3s(pose[:3, :3].copy(), MM * pose[:3, 3]))
        self._tool.computeAABB()
        return asked

    def touches_at(self, pose: Floats) -> bool:
        asked = self._asked(pose, self._coal.CollisionCallBackDefault())
        asked.data.request.enable_contact = False
        asked.init()
        self._parts.collide(self._tool, asked)
        return bool(asked.data.result.isCollision())

    def distance_at(self, pose: Floats) -> float:
        asked = self._asked(pose, self._coal.DistanceCallBackDefault())
        asked.init()
        self._parts.distance(self._tool, asked)
        return float(asked.data.result.min_distance) / MM


class Open3DBatch(BatchPeer):
    """Open3D: the nearest triangle of each point, many poses at once, on all processors."""

    name = "Open3D"
    close = 0.0
    """Metres within which a point on a surface touches it."""

    def __init__(self, parts: Sequence[Floats], tool: Mesh) -> None:  # noqa: ARG002
        self._open3d = _loaded("open3d")
        vertices, triangles = mesh_of(np.concatenate(parts))
        corners, faces = vertices.astype(np.float32), triangles.astype(np.uint32)
        self._scene = self._open3d.t.geometry.RaycastingScene()
        tensor = self._open3d.core.Tensor.from_numpy
        self._scene.add_triangles(tensor(corners), tensor(faces))

    def distances(self, points: Floats, poses: Floats) -> Floats:
        found = np.zeros(len(poses))
        step = max(1, POINTS_AT_ONCE // len(points))
        for at in range(0, len(poses), step):
            part = poses[at : at + step]
            placed = points @ part[:, :3, :3].transpose(0, 2, 1) + part[:, None, :3, 3]
            asked = self._open3d.core.Tensor.from_numpy(placed.astype(np.float32))
            found[at : at + step] = self._scene.compute_distance(asked).numpy().min(axis=1)
        return found

    def touches(self, points: Floats, poses: Floats) -> NDArray[np.bool_]:
        return self.distances(points, poses) <= self.close


PEERS = (FclBatch, CoalBatch, Open3DBatch)
