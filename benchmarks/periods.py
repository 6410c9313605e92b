"""Hands: lateness and computing time of periods with several slots.

    python benchmarks/periods.py [--old CHECKOUT] [--rates 1000 5000] [--slots 1 16]

Each turn is a process with one host: its hands press a ball of points on a plate. The results are
the median slot's p50, and the latest slot's p99 and p99.9 in us, medians over the turns. With
another checkout, the two take turns.
"""

import argparse
import itertools
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
from trimesh.transformations import translation_matrix

import hapticdb
import records
from hapticdb.session.host import SessionHost
from page_tables import publish

TURNS, SECONDS, POINTS = 3, 4.0, 300
VOXEL, RADIUS = 0.002, 0.012
MOVES_PER_SECOND = 30
NAMES = ("late p50", "late p99", "late p99.9", "took p50", "took p99", "took p99.9")


def plate(file: Path) -> None:
    """Import a plate whose top is at z = 0."""
    mesh = file.with_suffix(".stl")
    trimesh.creation.box(bounds=[(-0.1, -0.1, -0.02), (0.1, 0.1, 0.0)]).export(mesh)
    grid = hapticdb.GridOptions(voxel_size=VOXEL, bits=7)
    (report,) = hapticdb.import_files(str(file), [mesh], hapticdb.ImportOptions(grid=grid))
    if report.error is not None:
        raise report.error


def measured(file: str, n_slots: int, rate: float) -> list[float]:
    """Figures of one turn, us, in the order of NAMES."""
    with SessionHost(file, rate=rate) as host:
        begin = translation_matrix((0.0, 0.0, 0.03))
        ball = hapticdb.PointShell.sphere(RADIUS, POINTS)
        sessions = [host.begin(ball, begin) for _ in range(n_slots)]
        end = time.monotonic() + SECONDS
        while (left := end - time.monotonic()) > 0.0:
            for n, session in enumerate(sessions):
                z = RADIUS - 0.001 + 0.002 * np.sin(8.0 * left + n)
                session.move(translation_matrix((0.0, 0.0, z)))
            time.sleep(1.0 / MOVES_PER_SECOND)
        found = [session.figures() for session in sessions]
        counts = [session.counts() for session in sessions]
        shares = [c["contact_frames"] / f.frames for c, f in zip(counts, found, strict=True)]
        assert min(shares) > 0.1, shares
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


def main() -> None:
    """Take turns, or be one."""
    options = argparse.ArgumentParser(description=records.first_line(__doc__))
    options.add_argument("--old", type=Path, help="another checkout, measured in turns")
    options.add_argument("--slots", nargs="+", default=[1, 16], type=int)
    options.add_argument("--rates", nargs="+", default=[1000.0, 5000.0], type=float, help="Hz")
    options.add_argument("--turn", help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.turn:
        print(json.dumps(measured(given.turn, given.slots[0], given.rates[0])))
        return
    sides = {"this": records.ROOT} | ({"old": given.old.resolve()} if given.old else {})
    cells: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "plate.db")
        plate(file)
        for rate, n_slots in itertools.product(given.rates, given.slots):
            turns: dict[str, list[Any]] = {side: [] for side in sides}
            for side, checkout in [*sides.items()] * TURNS:
                line = [sys.executable, __file__, "--turn", str(file), "--slots", f"{n_slots}"]
                line += ["--rates", f"{rate}"]
                variables = os.environ | {"PYTHONPATH": str(checkout / "src")}
                done = subprocess.run(
                    line, env=variables, capture_output=True, text=True, timeout=300, check=True
                )
                turns[side].append(json.loads(done.stdout.splitlines()[-1]))
            for side, found in turns.items():
                us = dict(zip(NAMES, np.median(found, axis=0).tolist(), strict=True))
                cells.append({"rate": rate, "hands": n_slots, "side": side, "us": us})
                print(cells[-1], flush=True)
    publish("periods", cells, {"points": POINTS, "turns": TURNS, "seconds": SECONDS})


if __name__ == "__main__":
    main()
