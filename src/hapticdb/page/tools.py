"""Tools of the page: built-in probes, the operator's files, parts of the scene.

The origin of each is the centre of its AABB, also of its gizmo.
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticdb import mesh
from hapticdb.errors import FileError, UsageError
from hapticdb.pointshell.orientation import Surface
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import inset_of
from hapticdb.units import unit_doubt

LOG = logging.getLogger("hapticdb.page")
Floats = NDArray[np.float64]

LEAST_VOXELS = 3.0
"""Least radius of a probe, voxels. Larger: smoother forces in coarse grids, and larger probes."""
POINTS = 400
"""Points of a probe's shell. More: forces from smaller features, and longer frames."""
AROUND = 40
"""Segments of a probe's circumference. More: rounder, and more to send."""


@dataclass(frozen=True, eq=False)
class PageTool:
    """A tool of the page.

    sample : samples the point shell, by kernels; vertices (V, 3) : of its surface, metres, about
    the tool's centre; faces (F, 3) : vertex indices; is_round : smooth shading.
    """

    name: str
    sample: Callable[[], PointShell]
    vertices: Floats
    faces: NDArray[np.int64]
    is_round: bool = False

    @cached_property
    def shell(self) -> PointShell:
        """Point shell about the tool's centre, metres; sampled at first use."""
        return self.sample()

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere about the tool's centre, metres."""
        return float(np.linalg.norm(self.vertices, axis=1).max())


def built_in(diagonal: float, voxel_size: float, *, has_distances: bool) -> list[PageTool]:
    """Probes in proportion to a scene: a ball and a peg.

    diagonal : of the scene's AABB, metres; has_distances : whether forces come from distances, so
    that the shell is inset by the law's onset.
    """
    radius = max(0.028 * diagonal, LEAST_VOXELS * voxel_size)
    inset = inset_of(voxel_size, "distance" if has_distances else "plane")
    ball = np.linspace(-0.5 * math.pi, 0.5 * math.pi, AROUND // 2 + 1)
    peg = np.linspace(-0.5 * math.pi, 0.0, AROUND // 4 + 1)
    slim, long = 0.45 * radius, 3.2 * radius
    tip = np.column_stack([slim * np.cos(peg), slim * (1.0 + np.sin(peg)) - long / 2])
    shaft = np.array(
        [[slim, long / 4], [1.5 * slim, long / 4], [1.5 * slim, long / 2], [0, long / 2]]
    )
    profiles = radius * np.column_stack([np.cos(ball), np.sin(ball)]), np.concatenate([tip, shaft])
    found = []
    for name, profile in zip(("ball", "peg"), profiles, strict=True):
        vertices, faces = _turned(profile)
        sample = partial(PointShell.from_mesh, vertices, faces, POINTS, inset=inset)
        found.append(PageTool(name, sample, vertices, faces, is_round=name == "ball"))
    return found


def from_files(
    paths: Sequence[str], voxel_size: float, *, has_distances: bool, unit: str | None = None,
    extent: float = math.inf,
) -> list[PageTool]:  # fmt: skip
    """Tools of the operator's files, by the files' names; FileError without a surface.

    unit : as of `read_file`; unless it or the file gives one, the log has a note on a tool longer
    than `extent`, metres, or shorter than a voxel.
    """
    inset = inset_of(voxel_size, "distance" if has_distances else "plane")
    found = []
    for path in map(Path, paths):
        if path.suffix.lower() == ".npz":
            found.append(from_shell(path.stem, PointShell.load(path)))
            continue
        file = mesh.read_file(path, unit=unit)
        parts = [part for part in file.parts if not part.is_cloud]
        if not parts:
            raise FileError(f"{path}: no triangles; a tool needs a surface")
        vertices = np.concatenate([part.triangles() for part in parts]).reshape(-1, 3)
        length = float(np.ptp(vertices, axis=0).max())
        doubt = "" if unit or file.names_unit else unit_doubt(length, extent, voxel_size)
        if doubt:
            LOG.warning("hapticdb: the tool %s is %s", path.name, doubt)
        middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        faces = np.arange(len(vertices)).reshape(-1, 3)
        sample = partial(_centred_shell, vertices, faces, inset, file.link)
        found.append(PageTool(path.stem, sample, vertices - middle, faces))
    return found


def _centred_shell(
    vertices: Floats, faces: NDArray[np.int64], inset: float, link: str
) -> PointShell:
    shell = PointShell.from_mesh(vertices, faces, inset=inset)
    return from_shell("", replace(shell, link=link)).shell


def from_shell(name: str, shell: PointShell) -> PageTool:
    """Tool of a shell in any frame, moved so that the centre of its AABB is the origin."""
    middle = middle_of(shell)
    surface = shell.surface
    if isinstance(surface, Surface):
        surface = surface._replace(
            triangles=surface.triangles - middle, center=surface.center - middle
        )
        vertices = surface.triangles.reshape(-1, 3)
        faces = np.arange(len(vertices)).reshape(-1, 3)
    else:
        vertices, faces = _hull(shell.outline - middle)
        surface = None
    centred = replace(
        shell, points=shell.points - middle, center=shell.center - middle, surface=surface
    )
    return PageTool(name, lambda: centred, vertices, faces)


def middle_of(shell: PointShell) -> Floats:
    """Centre (3,) of the AABB of a shell's surface, metres, the shell's frame."""
    outline = shell.outline
    return np.asarray(0.5 * (outline.min(axis=0) + outline.max(axis=0)))


def _turned(profile: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Surface of revolution about the z axis of a profile (P, 2), radius and height."""
    angles = np.arange(AROUND) * (2.0 * math.pi / AROUND)
    radii, heights = profile[:, :1], np.repeat(profile[:, 1:], AROUND, axis=1)
    rings = np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=-1)
    ring, corner = np.meshgrid(np.arange(len(profile) - 1), np.arange(AROUND), indexing="ij")
    low, high = ring * AROUND, (ring + 1) * AROUND
    after = (corner + 1) % AROUND
    lower = np.stack([low + corner, low + after, high + after], axis=-1)
    upper = np.stack([low + corner, high + after, high + corner], axis=-1)
    faces = np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)])
    # equal corners become one: a ring on the axis is a point, and flat triangles go
    vertices, number = np.unique(np.round(rings.reshape(-1, 3), 9), axis=0, return_inverse=True)
    faces = number.reshape(-1)[faces]
    is_flat = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    return vertices, faces[~is_flat]


def _hull(points: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Convex hull of points (P, 3), metres: vertices, and faces wound outward."""
    from scipy.spatial import ConvexHull, QhullError  # noqa: PLC0415 - a third of a second

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError) as error:
        raise UsageError(
            "a saved shell of fewer than four points, or flat: give its mesh"
        ) from error
    faces = hull.simplices.astype(np.int64)
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # qhull's facets have no winding: compared with their outward normals
    is_inward = np.einsum("fk,fk->f", normals, hull.equations[:, :3]) < 0.0
    faces[is_inward] = faces[is_inward][:, ::-1]
    return points, faces


def start_pose(bounds: Floats, up: Floats, toward: Floats, radius: float, number: int) -> Floats:
    """Pose (4, 4) above the scene's AABB, without contact and in view.

    bounds : AABB (2, 3) of the scene, metres; up, toward : unit vectors, upward, and horizontal
    towards the eye; radius : of the tool, metres; number : of the person, for a row of tools.
    """
    middle, half = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
    side = np.cross(up, toward)
    # 0, 1, -1, 2, -2: in turn to both sides
    steps = (number + 1) // 2 * (1 if number % 2 else -1)
    pose = np.eye(4)
    pose[:3, 3] = middle + up * (float(np.abs(up) @ half) + 1.3 * radius)
    pose[:3, 3] += toward * (0.35 * float(np.abs(toward) @ half)) + side * (2.6 * radius * steps)
    pose[:3, :3] = np.column_stack([side, np.cross(up, side), up])
    return pose
