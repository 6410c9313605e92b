"""Peers that answer many poses of a tool: whether it touches the car, and how far it is from it.

Each has all of the car's triangles in memory. python-fcl and coal compare them with the tool's
triangles, a pose at a time: with one tree of boxes around all of the car, and with a tree for each
part below a tree of the parts. Open3D looks for the triangle nearest to each of the shell's points.
"""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from peers import INSTALL, PeerMissingError

Floats = NDArray[np.float64]

POINTS_AT_ONCE = 1 << 20
"""Points in one question to Open3D."""


class BatchPeer(Protocol):
    """Another program that answers poses (B, 4, 4), world_from_tool, on its own.

    name : as tables show it; compares : what it compares with the car's triangles.
    """

    name: str
    compares: str

    def build(self, parts: Sequence[Floats], tool: tuple[Floats, NDArray[np.int64]]) -> None:
        """Take in the corners (T, 3, 3) of each part, and vertices and faces of the tool, metres.

        Raises
        ------
        PeerMissingError
            If its package is not installed.
        """

    def distances(self, points: Floats, poses: Floats) -> Floats:
        """Distance (B,) of the tool, with shell points (N, 3), metres; 0 or less if it touches."""

    def touches(self, points: Floats, poses: Floats) -> NDArray[np.bool_]:
        """Whether the tool touches, (B,)."""


def _loaded(name: str) -> Any:  # noqa: ANN401 - modules without types
    try:
        return __import__(name)
    except (ImportError, OSError) as error:
        raise PeerMissingError(INSTALL) from error


def _vertices_and_faces(triangles: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (3 T, 3) and faces (T, 3) of corners (T, 3, 3)."""
    return triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)


class FclBatch:
    """python-fcl: mesh against mesh, in trees of boxes around the triangles of both."""

    name = "python-fcl"
    compares = "the tool's triangles"

    def build(self, parts: Sequence[Floats], tool: tuple[Floats, NDArray[np.int64]]) -> None:
        self._fcl = _loaded("fcl")
        self._car = self._object(*_vertices_and_faces(np.concatenate(parts)))
        self._tool = self._object(*tool)

    def _object(self, vertices: Floats, faces: NDArray[np.int64]) -> Any:  # noqa: ANN401
        """A tree of boxes around triangles, at rest."""
        model = self._fcl.BVHModel()
        model.beginModel(len(faces), len(vertices))
        model.addSubModel(vertices, faces)
        model.endModel()
        return self._fcl.CollisionObject(model, self._fcl.Transform())

    def touches(self, points: Floats, poses: Floats) -> NDArray[np.bool_]:  # noqa: ARG002
        found = np.zeros(len(poses), dtype=np.bool_)
        request = self._fcl.CollisionRequest(num_max_contacts=1)
        for n, pose in enumerate(poses):
            self._tool.setTransform(self._fcl.Transform(pose[:3, :3], pose[:3, 3]))
            result = self._fcl.CollisionResult()
            found[n] = self._fcl.collide(self._car, self._tool, request, result) > 0
        return found

    def distances(self, points: Floats, poses: Floats) -> Floats:  # noqa: ARG002
        found = np.zeros(len(poses))
        request = self._fcl.DistanceRequest()
        for n, pose in enumerate(poses):
            self._tool.setTransform(self._fcl.Transform(pose[:3, :3], pose[:3, 3]))
            result = self._fcl.DistanceResult()
            found[n] = self._fcl.distance(self._car, self._tool, request, result)
        return found


class FclPartsBatch(FclBatch):
    """python-fcl with a tree of boxes for each part, below a tree of the parts."""

    name = "python-fcl, parts"

    def build(self, parts: Sequence[Floats], tool: tuple[Floats, NDArray[np.int64]]) -> None:
        self._fcl = _loaded("fcl")
        self._all = [self._object(*_vertices_and_faces(part)) for part in parts]
        self._parts = self._fcl.DynamicAABBTreeCollisionManager()
        self._parts.registerObjects(self._all)
        self._parts.setup()
        self._tool = self._object(*tool)

    def touches(self, points: Floats, poses: Floats) -> NDArray[np.bool_]:  # noqa: ARG002
        fcl = self._fcl
        found = np.zeros(len(poses), dtype=np.bool_)
        request = fcl.CollisionRequest(num_max_contacts=1)
        for n, pose in enumerate(poses):
            self._tool.setTransform(fcl.Transform(pose[:3, :3], pose[:3, 3]))
            asked = fcl.CollisionData(request=request)
            self._parts.collide(self._tool, asked, fcl.defaultCollisionCallback)
            found[n] = asked.result.is_collision
        return found

    def distances(self, points: Floats, poses: Floats) -> Floats:  # noqa: ARG002
        fcl = self._fcl
        found = np.zeros(len(poses))
        for n, pose in enumerate(poses):
            self._tool.setTransform(fcl.Transform(pose[:3, :3], pose[:3, 3]))
            asked = fcl.DistanceData()
            self._parts.distance(self._tool, asked, fcl.defaultDistanceCallback)
            found[n] = asked.result.min_distance
        return found


class CoalBatch:
    """coal: the same, in a newer library."""

    name = "coal"
    compares = "the tool's triangles"

    def build(self, parts: Sequence[Floats], tool: tuple[Floats, NDArray[np.int64]]) -> None:
        self._coal = _loaded("coal")
        from peers.coal_meshes import tree_of_boxes  # noqa: PLC0415 - loads coal

        self._car = tree_of_boxes(*_vertices_and_faces(np.concatenate(parts)))
        self._tool = tree_of_boxes(*tool)
        self._here = self._coal.Transform3s()

    def touches(self, points: Floats, poses: Floats) -> NDArray[np.bool_]:  # noqa: ARG002
        coal = self._coal
        found = np.zeros(len(poses), dtype=np.bool_)
        request, result = coal.CollisionRequest(), coal.CollisionResult()
        request.enable_contact = False
        for n, pose in enumerate(poses):
            result.clear()
            there = coal.Transform3s(pose[:3, :3].copy(), pose[:3, 3].copy())
            found[n] = coal.collide(self._car, self._here, self._tool, there, request, result) > 0
        return found

    def distances(self, points: Floats, poses: Floats) -> Floats:  # noqa: ARG002
        coal = self._coal
        found = np.zeros(len(poses))
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        for n, pose in enumerate(poses):
            result.clear()
            there = coal.Transform3s(pose[:3, :3].copy(), pose[:3, 3].copy())
            found[n] = coal.distance(self._car, self._here, self._tool, there, request, result)
        return found


class CoalPartsBatch:
    """coal with a tree of boxes for each part, below a tree of the parts."""

    name = "coal, parts"
    compares = "the tool's triangles"

    def build(self, parts: Sequence[Floats], tool: tuple[Floats, NDArray[np.int64]]) -> None:
        self._coal = coal = _loaded("coal")
        from peers.coal_meshes import tree_of_boxes  # noqa: PLC0415 - loads coal

        self._all = [
            coal.CollisionObject(tree_of_boxes(*_vertices_and_faces(part))) for part in parts
        ]
        self._parts = coal.DynamicAABBTreeCollisionManager()
        for part in self._all:
            self._parts.registerObject(part)
        self._parts.setup()
        self._tool = coal.CollisionObject(tree_of_boxes(*tool))

    def _move(self, pose: Floats) -> None:
        there = self._coal.Transform3s(pose[:3, :3].copy(), pose[:3, 3].copy())
        self._tool.setTransform(there)
        self._tool.computeAABB()

    def touches(self, points: Floats, poses: Floats) -> NDArray[np.bool_]:  # noqa: ARG002
        found = np.zeros(len(poses), dtype=np.bool_)
        asked = self._coal.CollisionCallBackDefault()
        asked.data.request.enable_contact = False
        for n, pose in enumerate(poses):
            self._move(pose)
            asked.init()
            self._parts.collide(self._tool, asked)
            found[n] = asked.data.result.isCollision()
        return found

    def distances(self, points: Floats, poses: Floats) -> Floats:  # noqa: ARG002
        found = np.zeros(len(poses))
        asked = self._coal.DistanceCallBackDefault()
        for n, pose in enumerate(poses):
            self._move(pose)
            asked.init()
            self._parts.distance(self._tool, asked)
            found[n] = asked.data.result.min_distance
        return found


class Open3DBatch:
    """Open3D: the nearest triangle of each point, many poses at once, on all processors."""

    name = "Open3D"
    compares = "the shell's points"

    def __init__(self, close: float) -> None:
        self._close = close

    def build(self, parts: Sequence[Floats], tool: tuple[Floats, NDArray[np.int64]]) -> None:  # noqa: ARG002
        self._open3d = _loaded("open3d")
        vertices, triangles = _vertices_and_faces(np.concatenate(parts))
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
        return self.distances(points, poses) <= self._close


def batch_peers(close: float) -> Sequence[BatchPeer]:
    """All of them, not yet built. close: metres within which a point on a surface touches it."""
    return (FclBatch(), FclPartsBatch(), CoalBatch(), CoalPartsBatch(), Open3DBatch(close))
