"""Lateness and computing time of periods with several slots, two trees in turns.

    python benchmarks/periods.py --before /tmp/before/src --rate 5000 --slots 1 16

Each turn is a process with one host: its hands press a ball of points on a plate. Printed are
the median slot's p50, and the latest slot's p99 and p99.9 in us, medians over the turns, and the
ratio after / before of each.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import hapticdb
from hapticdb.session.host import SessionHost

TURNS, SECONDS = 5, 4.0
VOXEL, RADIUS = 0.002, 0.012
MOVES_PER_SECOND = 30
NAMES = ("late p50", "late p99", "late p99.9", "took p50", "took p99", "took p99.9")


def plate(file: Path) -> None:
    """Import a plate whose top is at z = 0."""
    mesh = file.with_suffix(".stl")
    box = trimesh.creation.box((0.2, 0.2, 0.02))
    box.apply_translation((0.0, 0.0, -0.01))
    box.export(mesh)
    grid = hapticdb.GridOptions(voxel_size=VOXEL, bits=7)
    (report,) = hapticdb.import_files(str(file), [mesh], hapticdb.ImportOptions(grid=grid))
    if report.error is not None:
        raise report.error


def ball(n_points: int) -> hapticdb.PointShell:
    """Evenly spread points of a ball."""
    n = np.arange(n_points) + 0.5
    angle, z = np.pi * (1.0 + 5.0**0.5) * n, 1.0 - 2.0 * n / n_points
    r = np.sqrt(1.0 - z * z)
    out = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    return hapticdb.PointShell(RADIUS * out, -out, np.zeros(3))


def measured(file: str, n_slots: int, rate: float, n_points: int) -> list[float]:
    """Figures of one turn, us, in the order of NAMES."""
    pose = np.eye(4)
    with SessionHost(file, rate=rate) as host:
        sessions = [host.begin(ball(n_points), pose + _up(0.03)) for _ in range(n_slots)]
        end = time.monotonic() + SECONDS
        while (left := end - time.monotonic()) > 0.0:
            for n, session in enumerate(sessions):
                session.move(pose + _up(RADIUS - 0.001 + 0.002 * np.sin(8.0 * left + n)))
            time.sleep(1.0 / MOVES_PER_SECOND)
        found = [session.figures() for session in sessions]
    spreads: list[Any] = [[figures.lateness for figures in found], [f.elapsed for f in found]]
    return [
        1e6 * value
        for all_ in spreads
        for value in (
            float(np.median([one.p50 for one in all_])),
            max(one.p99 for one in all_),
            max(one.p999 for one in all_),
        )
    ]


def _up(z: float) -> Any:  # noqa: ANN401 - (4, 4)
    shift = np.zeros((4, 4))
    shift[2, 3] = z
    return shift


def main() -> None:
    """Take turns, or be one."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--before", type=Path, help="src of the other tree; none: this one twice")
    options.add_argument("--slots", nargs="+", default=[1, 16, 64], type=int)
    options.add_argument("--rate", default=1000.0, type=float, help="Hz")
    options.add_argument("--points", default=300, type=int)
    options.add_argument("--turn", help=argparse.SUPPRESS)
    given = options.parse_args()
    here = Path(__file__).parents[1] / "src"
    if given.turn:
        print(json.dumps(measured(given.turn, given.slots[0], given.rate, given.points)))
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "plate.db")
        plate(file)
        for n_slots in given.slots:
            turns: dict[str, list[Any]] = {"before": [], "after": []}
            for _ in range(TURNS):
                for side, source in (("before", given.before or here), ("after", here)):
                    line = [sys.executable, __file__, "--turn", str(file), "--slots", f"{n_slots}"]
                    line += ["--rate", f"{given.rate}", "--points", f"{given.points}"]
                    variables = os.environ | {"PYTHONPATH": str(source)}
                    done = subprocess.run(
                        line, env=variables, capture_output=True, text=True, timeout=300, check=True
                    )
                    turns[side].append(json.loads(done.stdout.splitlines()[-1]))
            before, after = (np.median(turns[side], axis=0) for side in ("before", "after"))
            scene = f"{n_slots} slots at {given.rate:g} Hz, {given.points} points"
            print(f"{scene}, {TURNS} turns of {SECONDS:g} s, load {os.getloadavg()[0]:.1f}")
            for name, one, two in zip(NAMES, before, after, strict=True):
                print(f"  {name:<10} {one:9.1f} -> {two:9.1f} us  {two / max(one, 1e-9):6.3f}")


if __name__ == "__main__":
    main()
