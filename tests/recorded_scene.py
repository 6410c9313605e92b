"""A scene that records what a browser would draw, and an environment of a few parts."""

# ruff: noqa: ANN401 - properties of viser's nodes

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import hapticdb


class RecordedNode:
    """A node that was added; its properties may be set, as of viser's handles."""

    def __init__(self, nodes: "RecordedScene", name: str, **props: Any) -> None:
        self._nodes = nodes
        self._name = name
        self.visible = True
        self.__dict__.update(props)

    def __setattr__(self, name: str, value: Any) -> None:
        if isinstance(value, np.ndarray):
            self._nodes.bytes_sent += value.nbytes
        super().__setattr__(name, value)

    def remove(self) -> None:
        del self._nodes.nodes[self._name]


class RecordedScene:
    """What is drawn by one scope of viser: nodes by name."""

    def __init__(self) -> None:
        self.nodes: dict[str, RecordedNode] = {}
        self.bytes_sent = 0

    def add_batched_meshes_simple(  # as viser's
        self, name: str, vertices: Any, faces: Any, wxyzs: Any, positions: Any, **props: Any
    ) -> RecordedNode:
        props |= {"batched_wxyzs": np.asarray(wxyzs, np.float32), "vertices": vertices}
        props |= {"batched_positions": np.asarray(positions, np.float32), "faces": faces}
        self.bytes_sent += vertices.nbytes + faces.nbytes
        self.nodes[name] = RecordedNode(self, name, **props)
        return self.nodes[name]

    def add_point_cloud(self, name: str, points: Any, colours: Any, **props: Any) -> RecordedNode:
        props |= {"points": points, "colors": np.asarray(colours), "vertices": None}
        self.nodes[name] = RecordedNode(self, name, **props)
        return self.nodes[name]

    def add_frame(self, name: str, **props: Any) -> RecordedNode:
        self.nodes[name] = RecordedNode(self, name, vertices=None, **props)
        return self.nodes[name]


def drawn(shared: RecordedScene, own: RecordedScene | None = None) -> NDArray[np.float64]:
    """All triangles (n, 3, 3) that one browser draws: its own nodes hide shared ones by name."""
    nodes = shared.nodes | (own.nodes if own is not None else {})
    found = [np.empty((0, 3, 3))]
    for node in nodes.values():
        props = node.__dict__
        if props["vertices"] is None:
            continue
        corners = props["vertices"].astype(np.float64)[props["faces"].astype(np.int64)]
        count = len(props["batched_positions"])
        sizes = np.broadcast_to(
            np.asarray(props["batched_scales"], float).reshape(count, -1), (count, 3)
        )
        for wxyz, position, size in zip(
            props["batched_wxyzs"], props["batched_positions"], sizes, strict=True
        ):
            if size.any():
                turn = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()
                found.append((corners * size) @ turn.T + position + props["position"])
    return np.concatenate(found)


def are_same(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Whether two sets of triangles (n, 3, 3) are equal to 10 um, in any order and winding."""
    if len(one) != len(other) or not len(one):
        return len(one) == len(other)
    first, second = cKDTree(_moments(one)), cKDTree(_moments(other))
    there, back = first.query(second.data)[0], second.query(first.data)[0]
    return bool(np.max(there) < 1e-5 and np.max(back) < 1e-5)


def _moments(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Numbers (n, 12) that tell triangles apart and do not depend on the order of the corners."""
    squares = np.einsum("nci,ncj->nij", triangles, triangles)
    return np.concatenate([triangles.mean(axis=1), squares.reshape(-1, 9)], axis=1)


def write_parts(folder: Path, n_balls: int = 30, where: Sequence[float] = (0.0, 0.0, 0.0)) -> Path:
    """An environment of equal balls, one of them mirrored, boxes, and a red rod; its path."""
    scene = trimesh.Scene()
    placed = trimesh.transformations.translation_matrix(where)
    ball = trimesh.creation.icosphere(1, 0.03)
    for n in range(n_balls):
        at = trimesh.transformations.rotation_matrix(0.3 * n, [1, 2, 3])
        at[:3, 3] = 0.1 * (n % 8), 0.1 * (n // 8), 0.0
        if n == 3:
            at[:3, :3] = at[:3, :3] @ np.diag([1.0, -1.0, 1.0])
        scene.add_geometry(ball, f"ball-{n}", geom_name="ball", transform=placed @ at)
    for n in range(3):
        box = trimesh.creation.box((0.2, 0.1, 0.05 + 0.01 * n))
        at = trimesh.transformations.translation_matrix([0.1, 0.2, 0.2 + 0.1 * n])
        scene.add_geometry(box, f"frame-{n}", geom_name=f"box-{n}", transform=placed @ at)
    rod = trimesh.creation.cylinder(0.02, 0.4, sections=24)
    rod.visual.vertex_colors = [[200, 40, 40, 255]] * len(rod.vertices)
    stretched = placed @ np.diag([1.0, 2.0, 1.0, 1.0])
    scene.add_geometry(rod, "rod", geom_name="rod", transform=stretched)
    scene.export(folder / "parts.glb")
    grid = hapticdb.Grid(0.01, tuple(np.array(placed[:3, 3] - 0.5).tolist()), 8)
    with hapticdb.create(folder / "parts.db", grid, distances=False) as env:
        env.add(folder / "parts.glb")
    return folder / "parts.db"
