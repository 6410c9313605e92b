"""Does anything pass? Tools thrown at sheets and plates, or astride them; pegs in holes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb.bench.feel.couplings import RATE, Hand, Side, Terms, posed
from hapticdb.bench.feel.ground import Ground
from hapticdb.bench.feel.scenes import Scene, hole, plate, random_axes, round_hole
from hapticdb.bench.feel.tools import ball, peg, round_peg
from hapticdb.pointshell.shell import PointShell

Floats = NDArray[np.float64]

SIZES = (0.005, 0.0005)
"""Voxel sizes, metres."""
SPEEDS = (0.5, 20.0)
"""Slowest and fastest speed of a hand, m/s; drawn evenly by ratio."""
SPIN = 50.0
"""Fastest turning of a hand, rad/s."""
N_SHEETS = 25
"""Sheets of an environment, turned at random; each is tried several times."""
HALF = 30.0
"""Half edge of a sheet, voxels."""
ASIDE = 8.0
"""Way of a hand along the sheet on either side of it, voxels, at most: a tool that is held shall
not slide off the sheet."""
BEHIND = 2.0
"""Voxels behind the middle plane at which a point counts as passed. Less would count points in the
layer of voxels that a surface marks, in which the plane law has its contacts."""
RADIUS = 4.0
"""Radius of the thrown ball, voxels."""
POINTS = 60
"""Its points."""
LEAD = 12.0
"""Distance of the ball before and behind the sheet between which the hand goes, voxels, and at
least one and a half period's way."""
KINDS = (("sheets", 0.0), ("half-voxel plates", 0.5))
"""What is passed through, and its thickness in voxels."""
N_ASTRIDE = 24
"""Starts astride a sheet."""
FREE_N = 1e-9
"""Largest force, N, of a free tool."""
HOLE = 12.0
"""Width of the holes, voxels."""
PEG_LENGTH = 16.0
"""Length of the peg, voxels; the hole is 40 voxels deep."""
PEG_POINTS = 1000
"""Points of the peg."""
PEG_WAY = 32.0
"""Way of the peg's middle on either side of the hole's, voxels: in at one end, out at the other."""
CLEARANCES = (0.0, 0.025, 0.05, 0.1, 0.2, 0.3, 0.4, 0.8, 1.1, 1.4, 1.6, 1.8, 2.2, 3.0)
"""Radial clearances that are tried, voxels."""
FREE_TOUCH = 0.01
"""Largest force, N, that counts as none in a hole."""
STIFFNESS = 1000.0
"""K of the laws, N/m."""


class Throw(NamedTuple):
    """One throw: scene, speed, a point of the sheet, a direction and a turning, scene axes."""

    scene: Scene
    speed: float
    aim: Floats
    direction: Floats
    spin: Floats


def lead_of(speed: float, size: float) -> float:
    """Voxels before and behind a sheet between which a hand goes."""
    return max(LEAD + RADIUS, 1.5 * speed / RATE / size)


def throws(scenes: list[Scene], size: float, count: int, seed: int) -> list[Throw]:
    """Throws at scenes in turn: towards the middle part of a sheet, within 45 degrees of z."""
    rng = np.random.default_rng(seed)
    found = []
    for n in range(count):
        speed = SPEEDS[0] * (SPEEDS[1] / SPEEDS[0]) ** rng.uniform()
        aim = np.array([*rng.uniform(-6.0, 6.0, 2), 0.0])
        leading = lead_of(speed, size)
        aside = min(0.6, ASIDE / leading)
        direction = np.array([*rng.uniform(-aside, aside, 2), -1.0])
        spin = rng.normal(size=3)
        spin *= rng.uniform(0.0, SPIN) / np.linalg.norm(spin)
        scene = scenes[n % len(scenes)]
        found.append(Throw(scene, speed, aim, direction / np.linalg.norm(direction), spin))
    return found


def run_throw(side: Side, ground: Ground, throw: Throw) -> float:
    """Least height of the ball's points above the sheet's middle plane, voxels, over all periods.

    The hand goes through the sheet and rests behind it for 50 periods. A point beyond the sheet's
    edge does not count.
    """
    shell = ball(RADIUS, ground.size, POINTS)
    axes, origin = throw.scene.axes, ground.origins[throw.scene.name]
    lead = lead_of(throw.speed, ground.size) * ground.size
    start = ground.size * throw.aim - lead * throw.direction
    count = int(np.ceil(2.0 * lead * RATE / throw.speed))
    ways = np.minimum(np.arange(count + 50) * throw.speed / RATE, 2.0 * lead)
    hand = side.grasp(ground, shell, posed(origin + axes @ start), Terms())
    velocity, least = np.zeros(6), np.inf
    for n, way in enumerate(ways):
        moved = start + way * throw.direction
        turned = Rotation.from_rotvec(n / RATE * throw.spin).as_matrix()
        is_moving = way < 2.0 * lead
        velocity[:3] = axes @ throw.direction * throw.speed if is_moving else 0.0
        velocity[3:] = throw.spin
        hand.step(posed(origin + axes @ moved, turned), velocity)
        points = (hand.placed(shell.points) - origin) @ axes / ground.size
        is_over = (np.abs(points[:, :2]) < HALF - 1.0).all(axis=1)
        least = min(least, float(points[is_over, 2].min(initial=np.inf)))
    return least


def sheets_of_sessions(side: Side, folder: Path, count: int) -> dict[str, Any]:
    """Share of throws that were held: no point of the tool ever `BEHIND` the sheet or plate."""
    rows: list[dict[str, Any]] = []
    for size in SIZES:
        for kind, thickness in KINDS:
            axes = random_axes(min(N_SHEETS, count))
            reach = max(HALF, lead_of(SPEEDS[1], size) + 2.0 * RADIUS)
            scenes = [
                replace(plate(f"{kind} {n}", thickness, a, HALF), reach=reach)
                for n, a in enumerate(axes)
            ]
            with Ground.of_scenes(folder, scenes, size, distances=side.distances) as ground:
                heights = [
                    run_throw(side, ground, throw) for throw in throws(scenes, size, count, 0)
                ]
            held = sum(height > -BEHIND for height in heights)
            rows.append(
                {"size": size, "kind": kind, "count": count, "held": held,
                 "nearest": float(np.min(heights))}
            )  # fmt: skip
    share = min(row["held"] / row["count"] for row in rows)
    return {"values": [share], "nearest": min(row["nearest"] for row in rows), "cases": rows}


def starts_astride(side: Side, folder: Path, count: int) -> dict[str, Any]:
    """Share of starts astride a sheet from which the tool comes free without a step of force.

    The hand rests for 50 periods, then draws the tool out along the sheet's z at 50 mm/s, 30 voxels
    far. Free: no force at the end; no step: no change of the force above 0.05 N a period.
    """
    size = SIZES[0]
    scenes = [plate(f"sheet {n}", 0.0, a, HALF) for n, a in enumerate(random_axes(count))]
    rng = np.random.default_rng(1)
    free = 0
    held_up = []
    with Ground.of_scenes(folder, scenes, size, distances=side.distances) as ground:
        for scene in scenes:
            shell = ball(RADIUS, size, POINTS)
            offset = np.array([0.0, 0.0, rng.uniform(-0.8, 0.8) * RADIUS])
            forces = draw_out(side, ground, scene, size * offset, shell)
            steps = np.linalg.norm(np.diff(forces, axis=0), axis=1)
            is_free = np.linalg.norm(forces[-1]) <= FREE_N and float(steps.max()) <= 0.05
            free += int(is_free)
            held_up.append(float(np.linalg.norm(forces, axis=1).max()))
    return {"values": [free / count], "free": free, "count": count, "largest": max(held_up)}


def draw_out(side: Side, ground: Ground, scene: Scene, offset: Floats, shell: PointShell) -> Floats:
    """Forces (M, 3) from a start at an offset (3,), scene axes, until the tool is far away."""
    origin = ground.origins[scene.name] + scene.axes @ offset
    hand: Hand = side.grasp(ground, shell, posed(origin), Terms())
    speed = 0.05
    count = round(30.0 * ground.size / speed * RATE)
    ways = np.concatenate([np.zeros(50), np.arange(count) * speed / RATE])
    velocity = np.zeros(6)
    forces = np.empty((len(ways), 3))
    for n, way in enumerate(ways):
        velocity[:3] = scene.axes[:, 2] * (speed if way > 0.0 else 0.0)
        forces[n] = hand.step(posed(origin + way * scene.axes[:, 2]), velocity)
    return forces


# --- a peg ----------------------------------------------------------------------------------------


def clearances_of_pegs(side: Side, folder: Path, clearances: Sequence[float]) -> dict[str, Any]:
    """Least clearance, voxels, at which each peg, round and square, is free on all its way."""
    axes = random_axes(1)[0]
    values, cases = [], {}
    for scene, shape in ((round_hole(HOLE, axes), round_peg), (hole(HOLE, axes), peg)):
        forces = forces_in_hole(side, folder, scene, shape, clearances)
        free = [clearance for clearance, force in forces.items() if force <= FREE_TOUCH]
        values.append(min(free, default=math.inf))
        cases[scene.name] = forces
    return {"values": values, "cases": cases}


def forces_in_hole(
    side: Side,
    folder: Path,
    scene: Scene,
    shape: Callable[..., PointShell],
    clearances: Sequence[float],
) -> dict[float, float]:
    """Largest force of `touch` on a peg's way through a hole, N, at each clearance."""
    size, axes = SIZES[0], scene.axes
    heights = np.linspace(-PEG_WAY, PEG_WAY, 65)
    forces: dict[float, float] = {}
    with Ground.of_scenes(folder, [scene], size, distances=side.distances) as ground:
        middle = ground.origins[scene.name]
        poses = np.stack([posed(middle + size * height * axes[:, 2]) for height in heights])
        law = side.law_of(STIFFNESS)
        for clearance in clearances:
            width = HOLE - 2.0 * clearance
            shell = shape(width, PEG_LENGTH, size, axes, PEG_POINTS, side.onset)
            felt = ground.environment.touch_many(shell, poses, law=law).forces
            forces[clearance] = float(np.linalg.norm(felt, axis=1).max())
    return forces
