"""coal: mesh against mesh, exact, in trees of boxes around the triangles of both."""

from typing import Any

import coal
import numpy as np
from numpy.typing import NDArray

from peers import PeerWork, Pose
from peers.rows import resident_bytes

MOST_CONTACTS = 1000


class CoalMeshes:
    """All parts as one mesh, against the tool's mesh."""

    name = "coal"
    question = f"pairs of triangles that meet, exact, at most {MOST_CONTACTS}; no wrench"

    def build(self, work: PeerWork) -> None:
        before = resident_bytes()
        corners = work.triangles.reshape(-1, 3)
        self._car = tree_of_boxes(corners, np.arange(len(corners)).reshape(-1, 3))
        self._tool = tree_of_boxes(*work.tool_mesh)
        self._request = coal.CollisionRequest()
        self._request.enable_contact = True
        self._request.num_max_contacts = MOST_CONTACTS
        self._result = coal.CollisionResult()
        self._here = coal.Transform3s()
        self._bytes = max(resident_bytes() - before, 0)

    def frame(self, pose: Pose) -> int:
        self._result.clear()
        there = coal.Transform3s(pose[:3, :3].copy(), pose[:3, 3].copy())
        coal.collide(self._car, self._here, self._tool, there, self._request, self._result)
        return int(self._result.numContacts())

    def size(self) -> tuple[str, int]:
        return "memory", self._bytes

    def close(self) -> None:
        del self._car, self._tool


def tree_of_boxes(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Any:  # noqa: ANN401 - coal has no types
    """A tree of boxes around the triangles."""
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(faces), len(vertices))
    model.addVertices(np.ascontiguousarray(vertices))
    model.addTriangles(np.ascontiguousarray(faces, dtype=np.int64))
    model.endModel()
    return model


PEERS = (CoalMeshes,)
