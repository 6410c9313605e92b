"""Sessions whose hand is led: ripple, force, steps, an edge, time."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from feel.ground import (
    SIZE,
    Floats,
    Ground,
    Scene,
    convex_edge,
    on_slope,
    planes,
    posed,
    slope_axes,
)
from feel.hands import (
    ABOVE,
    RATE,
    SPEED,
    STIFFNESS,
    CoupledHand,
    largest_step,
    ripple,
    straight,
)
from hapticdb.kernels.field.distance_law import ONSET
from hapticdb.pointshell.shell import PointShell

SIZES = (0.005, 0.0005, 0.000116)
"""Voxel sizes, metres, at which the force is compared with k times the depth."""
DEPTHS = (0.0005, 0.002, 0.010)
"""Depths, metres, of the hand below the onset of contact, at which it slides."""
PRESSED = (0.002, 0.005, 0.010)
"""Depths, metres, at which the force is compared with k times the depth."""
SLIDE = 0.02
"""Way of a slide, metres."""
ACROSS = (3, 10)
"""Points along an edge of the flat tools."""
EDGE_DEPTHS = (0.4, 0.8)
"""Depths of the hand round the convex edge, voxels below the onset. At d the force k d turns with
the hand, whose way has the radius 1.5 s - d: 0.1 mm of it change the force by k d 0.1 mm / (1.5 s -
d), which passes 0.05 N at d = s / 2 for every voxel size s, and ends in a corner at 1.5 s."""


def slide_at_depths(ground: Ground, scene: Scene, across: int) -> list[float]:
    """Ripple of the normal force of a flat tool that slides at each of `DEPTHS`, one by one."""
    stand = ground.stand(scene)
    hand = CoupledHand.above(ground, stand, across)
    hand.lead(straight(stand.at(-ABOVE), stand.at(DEPTHS[0]), 0.01))
    ripples, last = [], (DEPTHS[0], 0.0)
    for n, depth in enumerate(DEPTHS):
        end = SLIDE if n % 2 == 0 else 0.0
        hand.lead(straight(stand.at(*last), stand.at(depth, last[1])))
        normal = hand.lead(straight(stand.at(depth, last[1]), stand.at(depth, end))) @ stand.normal
        ripples.append(ripple(normal[len(normal) // 4 :]))
        last = (depth, end)
    return ripples


def on_planes(folder: Path, n_random: int) -> dict[str, dict[str, Any]]:
    """Worst of all planes: ripple of all tools at each of `DEPTHS`; step a period on entering."""
    scenes = planes(n_random=n_random)
    rows, steps = [], []
    with Ground.of_scenes(folder, scenes) as ground:
        for scene in scenes:
            rows += [slide_at_depths(ground, scene, across) for across in ACROSS]
            stand = ground.stand(scene)
            entering = straight(stand.at(-ABOVE), stand.at(0.005), 0.01)
            steps.append(largest_step(CoupledHand.above(ground, stand, 3).lead(entering)))
    values = np.array(rows)
    n_without = int((values == np.inf).any(axis=1).sum())
    worst = np.where(values < np.inf, values, 0.0).max(axis=0).tolist()
    return {
        "session_ripple": {"values": worst, "without_force": n_without, "slides": len(rows)},
        "session_enter": {"values": [max(steps)]},
    }


# --- force against depth --------------------------------------------------------------------------


def press(folder: Path, size: float) -> tuple[list[float], dict[str, Any]]:
    """Forces at `PRESSED` at a voxel size, and the curve of force against depth."""
    with on_slope(folder, size) as (ground, stand):
        hand = CoupledHand.above(ground, stand, 3)
        forces, depths, curve, last = [], [], [], -ABOVE
        for depth in PRESSED:
            normal = hand.lead(straight(stand.at(last), stand.at(depth))) @ stand.normal
            depths += np.linspace(last, depth, len(normal)).tolist()
            curve += normal.tolist()
            there = straight(stand.at(depth), stand.at(depth, min(SLIDE, 10.0 * size)))
            slide = hand.lead(np.concatenate([there, there[-2::-1]])) @ stand.normal
            forces.append(float(slide.mean()))
            last = depth
    return forces, {"label": f"s = {size * 1e3:g} mm", "x": depths, "y": curve}


def force_of_sessions(folder: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Greatest error, at any voxel size, of the force at `PRESSED`; the curves of all sizes."""
    forces, curves = zip(*[press(folder, size) for size in SIZES], strict=True)
    errors = np.abs(np.array(forces) / (STIFFNESS * np.array(PRESSED)) - 1.0)
    return {"values": errors.max(axis=0).tolist()}, list(curves)


# --- a convex edge --------------------------------------------------------------------------------


def way_round_edge(radius: float, straight_part: float) -> tuple[Floats, Floats]:
    """Way round an edge at a distance, and the outward directions on it; both (M, 3), scene axes.

    A radius of 0 or less lies inside the solid: two lines that meet there.
    """
    r, lead = radius, min(radius, 0.0)
    up, out = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    first = straight(np.array([-straight_part, 0.0, r]), np.array([lead, 0.0, r]))
    count = max(round(0.5 * np.pi * r * RATE / SPEED), 1) if r > 0.0 else 0
    angles = np.linspace(0.0, 0.5 * np.pi, count + 2)[1:-1]
    turning = np.column_stack([np.sin(angles), np.zeros(len(angles)), np.cos(angles)])
    last = straight(np.array([r, 0.0, lead]), np.array([r, 0.0, -straight_part]))
    directions = [np.tile(up, (len(first), 1)), turning, np.tile(out, (len(last), 1))]
    return np.concatenate([first, max(r, 0.0) * turning, last]), np.concatenate(directions)


def edge_of_sessions(folder: Path) -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]]]:
    """Largest step within 0.1 mm and greatest side force round a convex edge; their curves."""
    scene = convex_edge(slope_axes(20.0))
    point = PointShell(np.zeros((1, 3)), scene.axes[:, 2][None], np.zeros(3), is_closed=False)
    tools = ("a point", 0.0, point), ("a ball", 4.0, PointShell.sphere(4.0 * SIZE, 300))
    steps, sides = list[float](), list[float]()
    curves: list[dict[str, Any]] = []
    with Ground.of_scenes(folder, [scene]) as ground:
        for depth in EDGE_DEPTHS:
            found = []
            for name, reach, shell in tools:
                step, side, drawn = round_edge(ground, scene, shell, depth, reach)
                found.append((step, side))
                if depth == EDGE_DEPTHS[0]:
                    curves += [each | {"label": f"{name}, {each['label']}"} for each in drawn]
            for worst, all_ in zip((steps, sides), zip(*found, strict=True), strict=True):
                worst.append(max(all_))
    return {"session_edge_step": {"values": steps}, "session_edge_side": {"values": sides}}, curves


def round_edge(
    ground: Ground, scene: Scene, shell: PointShell, depth: float, reach: float
) -> tuple[float, float, list[dict[str, Any]]]:
    """Lead a tool of radius `reach` round an edge at a depth, voxels: step, side force, curves."""
    path, outward = way_round_edge((ONSET - depth + reach) * SIZE, 0.02)
    path = ground.origins[scene.name] + path @ scene.axes.T
    outward = outward @ scene.axes.T
    start = path[0] + (depth * SIZE + ABOVE) * outward[0]
    hand = CoupledHand(ground, shell, start)
    hand.lead(straight(start, path[0]))
    hand.lead(np.repeat(path[:1], 100, axis=0))
    forces = hand.lead(path)
    along = np.einsum("nk,nk->n", forces, outward)
    sideways = np.linalg.norm(forces - along[:, None] * outward, axis=1)
    share = float(sideways.max()) / (STIFFNESS * depth * SIZE)
    ways = (np.arange(len(path)) * SPEED / RATE).tolist()
    curves = {"outward": along, "sideways": sideways}
    drawn = [{"label": label, "x": ways, "y": y.tolist()} for label, y in curves.items()]
    return largest_step(forces, apart=2), share, drawn


# --- computing time -------------------------------------------------------------------------------


def time_of_periods(folder: Path, count: int) -> dict[str, Any]:
    """Microseconds a period, p50 and p99, of 289 points in contact."""
    spent = np.empty(count)
    with on_slope(folder) as (ground, stand):
        hand = CoupledHand.above(ground, stand, 17)
        hand.lead(straight(stand.at(-ABOVE), stand.at(0.002)))
        velocity = np.zeros(6)
        for n in range(count):
            pose = posed(stand.at(0.002, SLIDE * np.sin(2.0 * np.pi * n / 2000.0)))
            started = time.perf_counter_ns()
            hand.step(pose, velocity)
            spent[n] = (time.perf_counter_ns() - started) / 1e3
    return {"values": np.percentile(spent[count // 10 :], (50, 99)).tolist(), "points": 17**2}
