"""Measures of `touch`: the force of a frame while a tool moves over closed forms."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from feel.ground import FILLING, SIZE, Floats, Ground, Scene, Stand, flat_tool, planes, posed
from feel.hands import largest_step, ripple
from hapticdb.kernels.field.distance_law import ONSET
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import DistanceField, ForceLaw, TangentPlane

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
SHOWN = ("0 degrees", "20 degrees", "45 degrees")
"""Planes whose force against depth is drawn."""


class Law(NamedTuple):
    """A law of `touch`.

    onset : voxels before the surface at which contact begins; layers : depths of the sheets of a
    scene, voxels: the tangent plane gets a solid one; force : the law itself.
    """

    name: str
    onset: float
    layers: tuple[float, ...]
    force: ForceLaw
    distances: bool

    def forces(self, ground: Ground, shell: PointShell, poses: Floats) -> Floats:
        """Forces (M, 3) of `touch` at poses (M, 4, 4)."""
        return ground.environment.touch(shell, poses=poses, law=self.force).forces


PLANE = Law("plane", 0.0, FILLING, TangentPlane(STIFFNESS), distances=False)
DISTANCE = Law("distance", ONSET, (0.0,), DistanceField(STIFFNESS), distances=True)


def slide_poses(ground: Ground, scene: Scene, height: float) -> Floats:
    """Poses (M, 4, 4) of a slide, askew to the axes, at a height in voxels over a plane."""
    stand = Stand(ground.origins[scene.name] + height * SIZE * scene.axes[:, 2], scene.axes)
    return np.stack([posed(stand.at(0.0, way)) for way in np.arange(0.0, SLIDE * SIZE, APART)])


def slides_of_touch(law: Law, folder: Path, n_random: int) -> dict[str, dict[str, Any]]:
    """Worst ripple, and largest step within 0.1 mm, on planes: each tool's worst of all depths."""
    scenes = planes(law.layers, n_random)
    rows: list[dict[str, Any]] = []
    curve: list[float] = []
    with Ground.of_scenes(folder, scenes, distances=law.distances) as ground:
        for scene in scenes:
            for across in ACROSS:
                shell = flat_tool(across, SIZE, scene.axes)
                for depth in DEPTHS:
                    poses = slide_poses(ground, scene, law.onset - depth)
                    forces = law.forces(ground, shell, poses)
                    normal = forces @ scene.axes[:, 2]
                    row = {"plane": scene.name, "points": across**2, "depth": depth}
                    rows.append(row | {"ripple": ripple(normal), "step": largest_step(forces)})
                    if (scene.name, across, depth) == ("20 degrees", 3, 0.5):
                        curve = normal.tolist()
    ripples = [
        max(row["ripple"] for row in rows if row["points"] == n**2 and row["ripple"] < np.inf)
        for n in ACROSS
    ]
    steps = [
        max(row["step"] for row in rows if row["depth"] <= depth) for depth in (SHALLOW, DEPTHS[-1])
    ]
    n_without = sum(row["ripple"] == np.inf for row in rows)
    ways = (np.arange(len(curve)) * APART * 1e3).tolist()
    return {
        "touch_ripple": {"values": ripples, "without_force": n_without, "slides": len(rows)},
        "touch_step": {"values": steps},
        "curve": {"label": "20 degrees, 9 points, depth 0.5 voxels", "x": ways, "y": curve},
    }


def depth_curves(law: Law, folder: Path) -> list[dict[str, Any]]:
    """Force against depth, -0.5 to 2 voxels below the onset, 9 points, on a few planes."""
    scenes = [scene for scene in planes(law.layers, 0) if scene.name in SHOWN]
    depths = np.linspace(-0.5, 2.0, 251)
    curves = []
    with Ground.of_scenes(folder, scenes, distances=law.distances) as ground:
        for scene in scenes:
            z = scene.axes[:, 2]
            origin = ground.origins[scene.name]
            poses = np.stack([posed(origin + (law.onset - d) * SIZE * z) for d in depths])
            forces = law.forces(ground, flat_tool(3, SIZE, scene.axes), poses)
            curves.append({"label": scene.name, "x": depths.tolist(), "y": (forces @ z).tolist()})
    return curves
