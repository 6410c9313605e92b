"""A walk over a model: one path of the hand, and the force on it."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from feel.ground import Floats, Ground
from feel.hands import RATE, CoupledHand, largest_step, straight
from hapticdb.environment import Environment
from hapticdb.kernels.field.distance_law import ONSET
from hapticdb.pointshell.shell import PointShell
from slide_paths import slide_along

RADIUS = 12.0
"""Radius of the ball that walks, voxels."""
POINTS = 300
"""Its points."""
PLACES = 1000
"""Places of the path that are taken from the map of heights; neighbours are a voxel or two apart.
More: a longer walk."""
SMOOTHING = 12.0
"""Places over which the path's heights are smoothed: the map has steps of a voxel, which a hand
does not make."""
PRESS = 0.002
"""Metres by which the hand goes below the surface."""
SPEED_LENGTHS = 0.1
"""Speed of the hand, lengths of the walk a second."""
SPEEDS = (0.02, 0.2)
"""Slowest and fastest speed of a hand, m/s."""
TREMBLE_HZ = 30.0
"""Frequencies above this one are no part of the hand's way: what is felt there is roughness."""
MOST_DRAWN = 2000
"""Samples of a curve that are kept for plots. More: larger files."""
NEAR = 48.0
"""Voxels around the path whose cells are fetched."""


def plan_walk(env: Environment, places: int) -> tuple[Floats, float]:
    """Way (M, 3) of the hand over the model's largest objects, one place a period; speed, m/s."""
    size = env.grid.voxel_size
    shell = PointShell.sphere(RADIUS * size, POINTS)
    raw = slide_along(env, shell.points, places)[:, :3, 3]
    smooth = gaussian_filter1d(raw, SMOOTHING, axis=0, mode="nearest")
    smooth[:, 2] -= PRESS
    steps = np.linalg.norm(np.diff(smooth, axis=0), axis=1)
    ways = np.concatenate([[0.0], np.cumsum(steps)])
    speed = float(np.clip(SPEED_LENGTHS * ways[-1], *SPEEDS))
    even = np.linspace(0.0, ways[-1], max(round(ways[-1] / speed * RATE), 2))
    hand = np.column_stack([np.interp(even, ways, smooth[:, axis]) for axis in range(3)])
    return gaussian_filter1d(hand, 10.0, axis=0, mode="nearest"), speed


def walk_over(url: str | Path, places: int = PLACES) -> tuple[dict[str, Any], dict[str, Any]]:
    """Walk over an environment: figures, and the force over time.

    The hand comes straight from above all objects: a tool that begins in something feels nothing
    until it is free.
    """
    with Ground(url) as ground:
        walk, speed = plan_walk(ground.environment, places)
        start = walk[0].copy()
        start[2] = max(start[2], *(obj.bounds[1, 2] for obj in ground.environment.objects()))
        start[2] += (RADIUS + NEAR) * ground.size
        lead = straight(start, walk[0], speed)
        apart = max(round(16.0 * ground.size / (speed / RATE)), 1)
        for place in np.concatenate([lead[::apart], walk[::apart]]):
            ground.fetch(place, NEAR)
        shell = PointShell.sphere(RADIUS * ground.size, POINTS)
        above = np.array([0.0, 0.0, ONSET * ground.size])
        hand = CoupledHand(ground, shell, lead[0] + above)
        hand.lead(lead + above)
        forces = hand.lead(walk + above)
    sizes = np.linalg.norm(forces, axis=1)
    every = max(len(sizes) // MOST_DRAWN, 1)
    times = (np.arange(len(sizes)) / RATE)[::every].tolist()
    found: dict[str, Any] = {"values": [largest_step(forces), trembling(forces)]}
    found |= {"mean": float(sizes.mean()), "peak": float(sizes.max())}
    return found, {"label": "force", "x": times, "y": sizes[::every].tolist()}


def trembling(forces: Floats) -> float:
    """Root mean square, N, of the part of forces (M, 3) above `TREMBLE_HZ`."""
    transformed = np.fft.rfft(forces - forces.mean(axis=0), axis=0)
    transformed[np.fft.rfftfreq(len(forces), 1.0 / RATE) < TREMBLE_HZ] = 0.0
    rough = np.fft.irfft(transformed, len(forces), axis=0)
    return float(np.sqrt(np.mean(np.sum(rough**2, axis=1))))
