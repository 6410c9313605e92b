"""A session across a whole environment, whose cells do not all fit into the memory budget.

The hand flies in a zigzag over every object with a given name, and dips into each one. `scale.py
--build` makes such an environment: the sample car 104 times, 1.4 billion voxels.

    python benchmarks/across.py DIR/scale_1404082368.db --over roof --speed 4 --budget 64
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, PointShell, ResidentCells, Session
from hapticdb.devices.scripted import Player

ABOVE = 0.05
DIP = 0.004
"""Metres: height above each object's top between dips, and depth of a dip below the top."""
RATE = 1000.0
"""Frames a second of the session."""
LONGEST_S = 3600.0
"""Seconds after which a session counts as failed; docs/realtime.md's flight takes five minutes."""


def places_over(env: Environment, word: str) -> NDArray[np.float64]:
    """Top centres (n, 3) of the objects whose name ends in a word, in a zigzag, metres."""
    found = [obj.bounds for obj in env.objects() if obj.name.endswith(word)]
    if not found:
        raise SystemExit(f"no object of {env.url} is named {word}")
    tops = np.array([[*(0.5 * (low + high))[:2], high[2]] for low, high in found])
    columns = np.round(tops[:, 0], 1)
    order: list[int] = []
    for turn, column in enumerate(np.unique(columns)):
        row = np.flatnonzero(columns == column)
        row = row[np.argsort(tops[row, 1])]
        order += (row if turn % 2 == 0 else row[::-1]).tolist()
    return tops[order]


def over(tops: NDArray[np.float64], speed: float) -> Player:
    """A hand that flies at `speed` (m/s) over all places and dips into each."""
    stops = np.repeat(tops, 3, axis=0)
    stops[:, 2] += np.tile([ABOVE, -DIP, ABOVE], len(tops))
    ways = np.linalg.norm(np.diff(stops, axis=0), axis=1)
    # a dip is slow: 0.1 m/s
    paces = np.where(np.arange(len(ways)) % 3 == 2, speed, 0.1)
    poses = np.tile(np.eye(4), (len(stops), 1, 1))
    poses[:, :3, 3] = stops
    return Player(np.concatenate([[0.0], np.cumsum(ways / paces)]), poses)


def main() -> None:
    """Fly, and print the report as JSON."""
    parser = argparse.ArgumentParser(description="A session across a whole environment.")
    parser.add_argument("url")
    parser.add_argument("--over", default="body/roof", help="end of the objects' names")
    parser.add_argument("--speed", type=float, default=4.0, help="between them, m/s")
    parser.add_argument("--budget", type=float, default=64.0, help="MiB")
    parser.add_argument("--tool", type=Path, help="a mesh; a ball of 3 cm without")
    given = parser.parse_args()
    with hapticdb.open(given.url, read_only=True) as env:
        tops = places_over(env, given.over)
        voxels = sum(obj.voxels for obj in env.objects())
    shell = PointShell.from_file(given.tool, 300) if given.tool else PointShell.sphere(0.03, 300)
    hand = over(tops, given.speed)
    with (
        ResidentCells(given.url, budget_bytes=int(given.budget * (1 << 20))) as cells,
        Session(cells, shell, hand, rate=RATE) as session,
    ):
        report = session.wait(LONGEST_S)
    if report is None:
        raise SystemExit(f"the session did not end within {LONGEST_S:g} s")
    figures = {"object_voxels": voxels, "objects_flown_over": len(tops), "speed": given.speed}
    json.dump(figures | report.figures(), sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
