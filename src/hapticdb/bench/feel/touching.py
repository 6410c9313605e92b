"""Measures of `touch`: the force of a frame while a tool moves over closed forms."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb.bench.feel.couplings import Side, posed
from hapticdb.bench.feel.figures import largest_step, ripple
from hapticdb.bench.feel.ground import Ground
from hapticdb.bench.feel.scenes import (
    FILLING,
    Scene,
    concave_corner,
    convex_edge,
    cylinder,
    planes,
    slope_axes,
)
from hapticdb.bench.feel.tools import ball, flat_tool
from hapticdb.pointshell.shell import PointShell

Floats = NDArray[np.float64]

SIZE = 0.005
"""Voxel size, metres."""
STIFFNESS = 1000.0
"""K of the laws, N/m."""
DEPTHS = (0.1, 0.2, 0.35, 0.5, 0.65, 0.8)
"""Depths below the onset of contact, voxels."""
APART = 0.0001
"""Distance of neighbouring poses, metres."""
SHALLOW = 0.5
"""Depth, voxels, up to which steps are told on their own: deeper, distances have a kink."""
SLIDE = 10.0
"""Way of a slide, voxels."""
ACROSS = (3, 10, 17)
"""Points along an edge of the flat tools: 9, 100, 289 points."""
RADIUS = 20.0
"""Radius of the cylinder, voxels."""
TILT = 20.0
"""Angle of the cylinder, the edge and the corner to the grid, degrees."""
BALL = 6.0
"""Radius of the ball that goes along the corner, voxels."""
SHOWN = ("0 degrees", "20 degrees", "45 degrees")
"""Planes whose force against depth is drawn."""


def layers_of(side: Side) -> tuple[float, ...]:
    """Sheets of a scene: the tangent plane gets a solid one."""
    return (0.0,) if side.distances else FILLING


def forces_at(side: Side, ground: Ground, shell: PointShell, poses: Floats) -> Floats:
    """Forces (M, 3) of `touch` at poses (M, 4, 4)."""
    touches = ground.environment.touch_many(shell, poses, law=side.law_of(STIFFNESS))
    return np.asarray(touches.forces)


def slide_poses(ground: Ground, scene: Scene, height: float) -> Floats:
    """Poses (M, 4, 4) of a slide, askew to the axes, at a height in voxels over a plane."""
    ways = np.arange(0.0, SLIDE * SIZE, APART)
    x, y, z = scene.axes.T
    along = np.cos(np.pi / 6) * x + np.sin(np.pi / 6) * y
    poses = np.tile(posed(ground.origins[scene.name] + height * SIZE * z), (len(ways), 1, 1))
    poses[:, :3, 3] += ways[:, None] * along
    return poses


def slides_of_touch(side: Side, folder: Path, n_random: int) -> dict[str, dict[str, Any]]:
    """Worst ripple, and largest step within 0.1 mm, on planes: each tool's worst of all depths."""
    scenes = planes(layers_of(side), n_random)
    rows: list[dict[str, Any]] = []
    curve: list[float] = []
    with Ground.of_scenes(folder, scenes, SIZE, distances=side.distances) as ground:
        for scene in scenes:
            for across in ACROSS:
                shell = flat_tool(across, SIZE, scene.axes)
                for depth in DEPTHS:
                    poses = slide_poses(ground, scene, side.onset - depth)
                    forces = forces_at(side, ground, shell, poses)
                    normal = forces @ scene.axes[:, 2]
                    row = {"plane": scene.name, "points": across**2, "depth": depth}
                    rows.append(row | {"ripple": ripple(normal), "step": largest_step(forces)})
                    if (scene.name, across, depth) == ("20 degrees", 3, 0.5):
                        curve = normal.tolist()
    ripples = [worst_ripple(r["ripple"] for r in rows if r["points"] == n**2) for n in ACROSS]
    unfelt = sum(row["ripple"] == np.inf for row in rows)
    ways = (np.arange(len(curve)) * APART * 1e3).tolist()
    return {
        "touch_ripple": {"values": ripples, "unfelt": unfelt, "slides": len(rows)},
        "touch_step": {"values": [step_to(rows, SHALLOW), step_to(rows, DEPTHS[-1])]},
        "curve": {"label": "20 degrees, 9 points, depth 0.5 voxels", "x": ways, "y": curve},
    }


def step_to(rows: Iterable[dict[str, Any]], depth: float) -> float:
    """Largest step of all slides down to a depth in voxels."""
    return max(float(row["step"]) for row in rows if row["depth"] <= depth)


def worst_ripple(ripples: Iterable[float]) -> float:
    """Largest finite ripple; a slide on which nothing is felt has none."""
    return max(value for value in ripples if value < np.inf)


def depth_curves(side: Side, folder: Path) -> list[dict[str, Any]]:
    """Force against depth, -0.5 to 2 voxels below the onset, 9 points, on a few planes."""
    scenes = [scene for scene in planes(layers_of(side), 0) if scene.name in SHOWN]
    depths = np.linspace(-0.5, 2.0, 251)
    curves = []
    with Ground.of_scenes(folder, scenes, SIZE, distances=side.distances) as ground:
        for scene in scenes:
            z = scene.axes[:, 2]
            origin = ground.origins[scene.name]
            poses = np.stack([posed(origin + (side.onset - d) * SIZE * z) for d in depths])
            forces = forces_at(side, ground, flat_tool(3, SIZE, scene.axes), poses)
            curves.append({"label": scene.name, "x": depths.tolist(), "y": (forces @ z).tolist()})
    return curves


# --- shapes that are no planes --------------------------------------------------------------------


def round_cylinder(side: Side, scene: Scene) -> Floats:
    """Poses (M, 4, 4) about the scene's origin that roll a flat tool over the cylinder's top."""
    depth, radius = 0.5, RADIUS * SIZE
    away = radius + (side.onset - depth) * SIZE
    angles = np.arange(-0.5, 0.5, APART / radius)
    turns = Rotation.from_rotvec(angles[:, None] * scene.axes[:, 1]).as_matrix()
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    poses[:, :3, :3] = turns
    poses[:, :3, 3] = away * turns @ scene.axes[:, 2] - radius * scene.axes[:, 2]
    return poses


def over_edge(side: Side, scene: Scene) -> Floats:
    """Poses (M, 4, 4) about the scene's origin that push a flat tool over the edge and off."""
    ways = np.arange(-8.0 * SIZE, 8.0 * SIZE, APART)
    height = (side.onset - 0.5) * SIZE
    poses = np.tile(np.eye(4), (len(ways), 1, 1))
    poses[:, :3, 3] = ways[:, None] * scene.axes[:, 0] + height * scene.axes[:, 2]
    return poses


def along_corner(side: Side, scene: Scene) -> Floats:
    """Poses (M, 4, 4) about the scene's origin that draw a ball along both walls of the corner."""
    ways = np.arange(0.0, SLIDE * SIZE, APART)
    away = (BALL + side.onset - 0.5) * SIZE
    poses = np.tile(np.eye(4), (len(ways), 1, 1))
    poses[:, :3, 3] = ways[:, None] * scene.axes[:, 1] + away * (
        scene.axes[:, 0] + scene.axes[:, 2]
    )
    return poses


def exact_forces(side: Side, scene: Scene, shell: PointShell, poses: Floats) -> Floats:
    """Forces (M, 3) of the smooth law over the exact distances of a closed form; poses about it."""
    assert scene.distance is not None  # noqa: S101 - these scenes have one
    found = []
    for pose in poses:
        points = shell.points @ pose[:3, :3].T + pose[:3, 3]
        normals = shell.normals @ pose[:3, :3].T
        u = scene.distance(points @ scene.axes / SIZE)
        depths = SIZE * np.maximum(0.0, side.onset - u)
        weight = float(np.clip(side.onset + 1.0 - u, 0.0, 1.0).sum())
        total = STIFFNESS * (depths[:, None] * normals).sum(axis=0)
        found.append(total / max(1.0, weight / 10.0))
    return np.array(found)


def shapes_of_touch(side: Side, folder: Path) -> dict[str, dict[str, Any]]:
    """Ripple and largest steps on a cylinder, an edge and a corner; errors from the exact law."""
    axes, layers = slope_axes(TILT), layers_of(side)
    scenes = [
        cylinder(RADIUS, axes, layers), convex_edge(axes, layers), concave_corner(axes, layers)
    ]  # fmt: skip
    tools = [flat_tool(3, SIZE, axes), flat_tool(10, SIZE, axes), ball(BALL, SIZE, 300)]
    ways = [round_cylinder, over_edge, along_corner]
    steps, errors, forces_of = [], [], []
    with Ground.of_scenes(folder, scenes, SIZE, distances=side.distances) as ground:
        for scene, shell, way in zip(scenes, tools, ways, strict=True):
            local = way(side, scene)
            poses = local.copy()
            poses[:, :3, 3] += ground.origins[scene.name]
            forces = forces_at(side, ground, shell, poses)
            forces_of.append(forces)
            steps.append(largest_step(forces))
            exact = exact_forces(side, scene, shell, local)
            largest = float(np.linalg.norm(exact, axis=1).max())
            if side.distances:
                errors.append(float(np.linalg.norm(forces - exact, axis=1).max()) / largest)
    sizes = np.linalg.norm(forces_of[0], axis=1)
    return {
        "touch_cylinder": {"values": [ripple(sizes)]},
        "touch_shape_steps": {"values": steps},
        "touch_errors": {"values": errors},
    }
