"""Sessions whose hand is led: ripple, force, steps, an edge, time."""

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from feel.couplings import RATE, STIFFNESS, CoupledHand, Drive, Terms, drive, posed, straight
from feel.figures import largest_step, ripple
from feel.ground import Ground
from feel.scenes import Scene, convex_edge, plane, planes, slope_axes
from feel.tools import ball, flat_tool
from hapticdb.kernels.field.distance_law import ONSET
from hapticdb.pointshell.shell import PointShell

Floats = NDArray[np.float64]

SIZE = 0.005
"""Voxel size, metres, where a measure names no other."""
SIZES = (0.005, 0.0005, 0.000116)
"""Voxel sizes, metres, at which the force is compared with k times the depth."""
DEPTHS = (0.0005, 0.002, 0.010)
"""Depths, metres, of the hand below the onset of contact, at which it slides."""
PRESSED = (0.002, 0.005, 0.010)
"""Depths, metres, at which the force is compared with k times the depth."""
SPEED = 0.05
"""Speed of a sliding hand, m/s: 0.05 mm a period."""
SLIDE = 0.02
"""Way of a slide, metres."""
ABOVE = 0.002
"""Height above the onset from which a hand comes, metres."""
ACROSS = (3, 10)
"""Points along an edge of the flat tools."""
EDGE_DEPTHS = (0.4, 0.8)
"""Depths of the hand round the convex edge, voxels below the onset. At d the force k d turns with
the hand, whose way has the radius 1.5 s - d: 0.1 mm of it change the force by k d 0.1 mm / (1.5 s -
d), which passes 0.05 N at d = s / 2 for every voxel size s, and ends in a corner at 1.5 s."""


class Stand(NamedTuple):
    """A place on a plane: the onset of contact there (3,), metres, and the scene's axes (3, 3)."""

    onset: Floats
    axes: Floats

    @property
    def normal(self) -> Floats:
        """Unit vector (3,) away from the surface."""
        return np.asarray(self.axes[:, 2])

    def at(self, depth: float, along: float = 0.0) -> Floats:
        """Point (3,) at a depth below the onset, and metres along, askew to both axes."""
        way = np.cos(np.pi / 6) * self.axes[:, 0] + np.sin(np.pi / 6) * self.axes[:, 1]
        return np.asarray(self.onset - depth * self.normal + along * way)


def stand_on(ground: Ground, scene: Scene) -> Stand:
    """The onset of contact over a scene's origin."""
    above = ONSET * ground.size * scene.axes[:, 2]
    return Stand(ground.origins[scene.name] + above, scene.axes)


def normal_force(way: Drive, normal: Floats) -> Floats:
    """Forces (M,) along a normal (3,), N."""
    return np.asarray(way.forces @ normal)


class Slides(NamedTuple):
    """Normal forces, N, of one tool on one plane: sliding at each depth, and on the way in."""

    sliding: list[Floats]
    entering: Floats


def slide_at_depths(ground: Ground, scene: Scene, shell: PointShell) -> Slides:
    """Press a flat tool in, deeper and deeper, and slide at each of `DEPTHS`."""
    stand = stand_on(ground, scene)
    hand = CoupledHand(ground, shell, posed(stand.at(-ABOVE)), Terms())
    entering = drive(hand, straight(stand.at(-ABOVE), stand.at(DEPTHS[0]), 0.01))
    forces, last = [], (DEPTHS[0], 0.0)
    for n, depth in enumerate(DEPTHS):
        end = SLIDE if n % 2 == 0 else 0.0
        drive(hand, straight(stand.at(*last), stand.at(depth, last[1]), SPEED))
        way = drive(hand, straight(stand.at(depth, last[1]), stand.at(depth, end), SPEED))
        settled = len(way.forces) // 4
        forces.append(normal_force(way, stand.normal)[settled:])
        last = (depth, end)
    return Slides(forces, normal_force(entering, stand.normal))


def ripple_of_sessions(folder: Path, n_random: int) -> dict[str, Any]:
    """Worst ripple of all planes and tools at each of `DEPTHS`."""
    scenes = planes(n_random=n_random)
    rows: list[dict[str, Any]] = []
    with Ground.of_scenes(folder, scenes, SIZE, distances=True) as ground:
        for scene in scenes:
            for across in ACROSS:
                shell = flat_tool(across, SIZE, scene.axes)
                found = slide_at_depths(ground, scene, shell)
                ripples = [ripple(force) for force in found.sliding]
                rows.append({"points": across**2, "values": ripples})
    values = np.array([row["values"] for row in rows])
    n_without = int((values == np.inf).any(axis=1).sum())
    worst = np.where(values < np.inf, values, 0.0).max(axis=0)
    return {"values": worst.tolist(), "without_force": n_without, "slides": len(rows)}


def step_on_entering(folder: Path, n_random: int) -> dict[str, Any]:
    """Largest change of force a millisecond when a hand comes in at 10 mm/s, of all planes."""
    scenes = planes(n_random=n_random)
    steps = []
    with Ground.of_scenes(folder, scenes, SIZE, distances=True) as ground:
        for scene in scenes:
            stand = stand_on(ground, scene)
            shell = flat_tool(3, SIZE, scene.axes)
            hand = CoupledHand(ground, shell, posed(stand.at(-ABOVE)), Terms())
            way = drive(hand, straight(stand.at(-ABOVE), stand.at(0.005), 0.01))
            steps.append(largest_step(way.forces))
    return {"values": [max(steps)], "cases": steps}


# --- force against depth --------------------------------------------------------------------------


def press(folder: Path, size: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Forces at `PRESSED` at a voxel size, and the curve of force against depth."""
    scene = plane("20 degrees", slope_axes(20.0))
    with Ground.of_scenes(folder, [scene], size, distances=True) as ground:
        stand = stand_on(ground, scene)
        shell = flat_tool(3, size, scene.axes)
        hand = CoupledHand(ground, shell, posed(stand.at(-ABOVE)), Terms())
        forces, depths, curve, last = [], [], [], -ABOVE
        for depth in PRESSED:
            way = drive(hand, straight(stand.at(last), stand.at(depth), SPEED))
            depths += np.linspace(last, depth, len(way.forces)).tolist()
            curve += normal_force(way, stand.normal).tolist()
            ahead = min(SLIDE, 10.0 * size)
            there = straight(stand.at(depth), stand.at(depth, ahead), SPEED)
            slide = np.concatenate([there, there[-2::-1]])
            forces.append(float(normal_force(drive(hand, slide), stand.normal).mean()))
            last = depth
    found = {"size": size, "forces": forces}
    label = f"s = {size * 1e3:g} mm"
    return found, {"label": label, "x": depths, "y": curve}


def force_of_sessions(folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Greatest error, at any voxel size, of the force at `PRESSED`; the curves of all sizes."""
    cases, curves = zip(*[press(folder, size) for size in SIZES], strict=True)
    wanted = STIFFNESS * np.array(PRESSED)
    errors = [np.abs(np.array(case["forces"]) / wanted - 1.0) for case in cases]
    return {"values": np.max(errors, axis=0).tolist(), "cases": list(cases)}, list(curves)


# --- a convex edge --------------------------------------------------------------------------------


def way_round_edge(
    radius: float, straight_part: float, rate: float = RATE
) -> tuple[Floats, Floats]:
    """Way round an edge at a distance, and the outward directions on it; both (M, 3), scene axes.

    A radius of 0 or less lies inside the solid: two lines that meet there.
    """
    r = radius
    up, out = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    lead = min(r, 0.0)
    first = straight(np.array([-straight_part, 0.0, r]), np.array([lead, 0.0, r]), SPEED, rate)
    count = max(round(0.5 * np.pi * r * rate / SPEED), 1) if r > 0.0 else 0
    angles = np.linspace(0.0, 0.5 * np.pi, count + 2)[1:-1]
    turning = np.column_stack([np.sin(angles), np.zeros(len(angles)), np.cos(angles)])
    last = straight(np.array([r, 0.0, lead]), np.array([r, 0.0, -straight_part]), SPEED, rate)
    directions = [np.tile(up, (len(first), 1)), turning, np.tile(out, (len(last), 1))]
    return np.concatenate([first, max(r, 0.0) * turning, last]), np.concatenate(directions)


def edge_of_sessions(folder: Path) -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]]]:
    """Largest step within 0.1 mm and greatest side force round a convex edge; their curves."""
    scene = convex_edge(slope_axes(20.0))
    rows: list[dict[str, Any]] = []
    curves: list[dict[str, Any]] = []
    with Ground.of_scenes(folder, [scene], SIZE, distances=True) as ground:
        for depth in EDGE_DEPTHS:
            for name, reach in (("a point", 0.0), ("a ball", 4.0)):
                found, drawn = round_edge(ground, scene, depth, reach)
                rows.append({"tool": name, "depth": depth} | found)
                if depth == EDGE_DEPTHS[0]:
                    curves += [each | {"label": f"{name}, {each['label']}"} for each in drawn]

    def worst(figure: str) -> list[float]:
        return [max(r[figure] for r in rows if r["depth"] == depth) for depth in EDGE_DEPTHS]

    return {
        "session_edge_step": {"values": worst("step"), "cases": rows},
        "session_edge_side": {"values": worst("side")},
    }, curves


def round_edge(
    ground: Ground, scene: Scene, depth: float, reach: float
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Lead a ball of radius `reach` voxels, or a point for 0, round an edge; depth in voxels."""
    shell = ball(reach, SIZE, 300) if reach else point_tool(scene.axes)
    path, outward = way_round_edge((ONSET - depth + reach) * SIZE, 0.02)
    path = ground.origins[scene.name] + path @ scene.axes.T
    outward = outward @ scene.axes.T
    start = path[0] + (depth * SIZE + ABOVE) * outward[0]
    hand = CoupledHand(ground, shell, posed(start), Terms())
    drive(hand, straight(start, path[0], SPEED))
    drive(hand, np.repeat(path[:1], 100, axis=0))
    forces = drive(hand, path).forces
    along = np.einsum("nk,nk->n", forces, outward)
    sideways = np.linalg.norm(forces - along[:, None] * outward, axis=1)
    share = float(sideways.max()) / (STIFFNESS * depth * SIZE)
    ways = (np.arange(len(path)) * SPEED / RATE).tolist()
    return {"step": largest_step(forces, apart=2), "side": share}, [
        {"label": "outward", "x": ways, "y": along.tolist()},
        {"label": "sideways", "x": ways, "y": sideways.tolist()},
    ]


def point_tool(axes: Floats) -> PointShell:
    """A tool of one point, its inside at a scene's +z."""
    return PointShell(np.zeros((1, 3)), axes[:, 2][None], np.zeros(3), is_closed=False)


# --- computing time -------------------------------------------------------------------------------


def time_of_periods(folder: Path, count: int) -> dict[str, Any]:
    """Microseconds a period, p50 and p99, of 289 points in contact."""
    scene = plane("20 degrees", slope_axes(20.0))
    spent = np.empty(count)
    with Ground.of_scenes(folder, [scene], SIZE, distances=True) as ground:
        stand = stand_on(ground, scene)
        shell = flat_tool(17, SIZE, scene.axes)
        hand = CoupledHand(ground, shell, posed(stand.at(-ABOVE)), Terms())
        drive(hand, straight(stand.at(-ABOVE), stand.at(0.002), SPEED))
        velocity, pose = np.zeros(6), np.eye(4)
        for n in range(count):
            pose[:3, 3] = stand.at(0.002, SLIDE * np.sin(2.0 * np.pi * n / 2000.0))
            started = time.perf_counter_ns()
            hand.step(pose, velocity)
            spent[n] = (time.perf_counter_ns() - started) / 1e3
    return {"values": np.percentile(spent[count // 10 :], (50, 99)).tolist(), "points": 17**2}
