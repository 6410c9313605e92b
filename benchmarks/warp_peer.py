"""Distances on a GPU by triangles: mesh queries of Warp, beside which `on_gpu` measures."""

import numpy as np
import warp as wp
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@wp.kernel  # type: ignore[untyped-decorator]
def _nearest(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
    poses: wp.array(dtype=wp.mat44),  # type: ignore[valid-type]
    reach: float,
    out: wp.array(dtype=float),  # type: ignore[valid-type]
) -> None:
    """Least distance of a shell's points from the mesh at each pose, `reach` at most."""
    pose, at = wp.tid()
    place = wp.transform_point(poses[pose], points[at])
    found = wp.mesh_query_point_no_sign(mesh, place, reach)
    if found.result:
        there = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
        wp.atomic_min(out, pose, wp.length(there - place))


class WarpMesh:
    """All triangles (F, 3, 3) of a scene as one mesh on the GPU, and a shell's points (N, 3)."""

    def __init__(self, triangles: Floats, points: Floats, device: str = "cuda") -> None:
        wp.init()
        corners = np.ascontiguousarray(triangles.reshape(-1, 3), dtype=np.float32)
        self._device = device
        self._mesh = wp.Mesh(
            points=wp.array(corners, dtype=wp.vec3, device=device),
            indices=wp.array(
                np.arange(len(corners), dtype=np.int32), dtype=wp.int32, device=device
            ),
        )
        self._points = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)

    def distances(self, poses: Floats, reach: float) -> NDArray[np.float32]:
        """Least distances (B,) of the points from a triangle at poses (B, 4, 4), metres."""
        given = wp.array(poses.astype(np.float32), dtype=wp.mat44, device=self._device)
        out = wp.array(np.full(len(poses), reach, np.float32), dtype=float, device=self._device)
        wp.launch(
            _nearest,
            dim=(len(poses), len(self._points)),
            inputs=[self._mesh.id, self._points, given, reach],
            outputs=[out],
            device=self._device,
        )
        return np.asarray(out.numpy())
