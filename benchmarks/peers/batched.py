"""Peers that answer many poses of a tool: whether it touches the car, and how far it is from it.

Each has all of the car's triangles in memory. python-fcl and coal compare them with the tool's
triangles, a pose at a time; Open3D looks for the triangle nearest to each of the shell's points.
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

    def build(self, triangles: Floats, tool: tuple[Floats, NDArray[np.int64]]) -> None:
        """Take in the car's corners (T, 3, 3), and vertices and faces of the tool, metres.

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


class FclBatch:
    """python-fcl: mesh against mesh, in trees of boxes around the triangles of both."""

    name = "python-fcl"
    compares = "the tool's triangles"

    def build(self, triangles: Floats, tool: tuple[Floats, NDArray[np.int64]]) -> None:
        self._fcl = _loaded("fcl")
        corners = triangles.reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        self._car = self._fcl.CollisionObject(self._tree(corners, faces), self._fcl.Transform())
        self._tool = self._fcl.CollisionObject(self._tree(*tool), self._fcl.Transform())

    def _tree(self, vertices: Floats, faces: NDArray[np.int64]) -> Any:  # noqa: ANN401
        model = self._fcl.BVHModel()
        model.beginModel(len(faces), len(vertices))
        model.addSubModel(vertices, faces)
        model.endModel()
        return model

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


class CoalBatch:
    """coal: the same, in a newer library."""

    name = "coal"
    compares = "the tool's triangles"

    def build(self, triangles: Floats, tool: tuple[Floats, NDArray[np.int64]]) -> None:
        self._coal = _loaded("coal")
        from peers.coal_meshes import tree_of_boxes  # noqa: PLC0415 - loads coal

        corners = triangles.reshape(-1, 3)
        self._car = tree_of_boxes(corners, np.arange(len(corners)).reshape(-1, 3))
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


class Open3DBatch:
    """Open3D: the nearest triangle of each point, many poses at once, on all processors."""

    name = "Open3D"
    compares = "the shell's points"

    def __init__(self, close: float) -> None:
        self._close = close

    def build(self, triangles: Floats, tool: tuple[Floats, NDArray[np.int64]]) -> None:  # noqa: ARG002
        self._open3d = _loaded("open3d")
        corners = triangles.reshape(-1, 3).astype(np.float32)
        faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
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
    return (FclBatch(), CoalBatch(), Open3DBatch(close))
