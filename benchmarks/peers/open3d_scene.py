"""Open3D: rays and nearest points on the car's triangles, all in memory, in single precision.

Both ask about closed surfaces, and the car's are not: parts are open, overlap, and lie in one
another, so that counting what a ray crosses calls some points outside that are inside a part.
"""

from abc import abstractmethod

import numpy as np
import open3d
from numpy.typing import NDArray

from peers import PeerWork, Pose
from peers.rows import resident_bytes


class RaycastingPeer:
    """The triangles in Open3D's scene."""

    name: str
    question: str

    def build(self, work: PeerWork) -> None:
        before = resident_bytes()
        corners = work.triangles.reshape(-1, 3).astype(np.float32)
        faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        tensor = open3d.core.Tensor.from_numpy
        self._scene.add_triangles(tensor(corners), tensor(faces))
        self._points = work.shell.points
        self._half = work.env.grid.voxel_size / 2
        self.frame(np.eye(4))  # the first question builds the tree
        self._bytes = max(resident_bytes() - before, 0)

    def frame(self, pose: Pose) -> int:
        placed = (self._points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
        return self.count(placed)

    @abstractmethod
    def count(self, placed: NDArray[np.float32]) -> int:
        """Count points (N, 3) that are in, in this peer's own sense."""

    def size(self) -> tuple[str, int]:
        return "memory", self._bytes

    def close(self) -> None:
        del self._scene


class Occupancy(RaycastingPeer):
    """Whether points lie inside the surfaces."""

    name = "Open3D occupancy"
    question = "points inside closed surfaces, by rays; no wrench"

    def count(self, placed: NDArray[np.float32]) -> int:
        asked = open3d.core.Tensor.from_numpy(placed)
        return int(np.count_nonzero(self._scene.compute_occupancy(asked, nthreads=1).numpy()))


class SignedDistance(RaycastingPeer):
    """How far points are from the nearest surface."""

    name = "Open3D signed distance"
    question = "points within half a voxel of the exact surface, with distance; no wrench"

    def count(self, placed: NDArray[np.float32]) -> int:
        asked = open3d.core.Tensor.from_numpy(placed)
        distances = self._scene.compute_signed_distance(asked, nthreads=1).numpy()
        return int(np.count_nonzero(np.abs(distances) <= self._half))


PEERS = (Occupancy, SignedDistance)
