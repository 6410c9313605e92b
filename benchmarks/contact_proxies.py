"""Contact proxies over a network that delays, beside the coupling on this machine.

    python benchmarks/contact_proxies.py                # the vintage car, or the sample car

The server and the relay are processes of their own on 127.0.0.1. The client moves a ball along each
path in real time, 1000 times a second; the coupling of this machine has felt the same path before.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import hapticdb
import page_tables
import records
from delaying import READY_WITHIN, delayed
from feel.couplings import SmoothHand, Terms, posed, straight
from feel.ground import Ground
from feel.scenes import concave_corner, convex_edge, plane, slope_axes
from feel.sliding import SPEED, way_round_edge
from feel.tools import ball
from hapticdb import GridOptions, ImportOptions
from hapticdb.client import ContactProxy
from hapticdb.kernels.compiling import compile_missing, entries_for
from hapticdb.pointshell.shell import PointShell
from hapticdb.sample import write_sample
from paper.workload import slide_poses

TESTS = Path(__file__).parent.parent / "tests"
sys.path.insert(0, str(TESTS))

from contact_server import TOKEN  # noqa: E402 - of the tests' folder

Floats = NDArray[np.float64]
Line = dict[str, Any]

SIZE = 0.005
"""Voxel size of the closed forms, metres."""
BALL, POINTS = 4.0, 300
"""Radius of the ball, voxels, and its points. More points: a smoother ball, and longer frames."""
DEPTH = 0.8
"""Depth of the hand below the onset of contact, voxels."""
LATENCIES = (0.0, 0.010, 0.050)
"""Seconds added to a round trip, half of them each way."""
CAP = 7.0
"""Greatest force that the server grants, N."""
CAR = "demo_vintage_car/vintage_car.glb"
BITS, EXTENT = 10, 1.6
"""Grid of the car: bits an axis, and its edge as a multiple of the model's longest side."""
CAR_SPEED, PRESSED = 20.0, 1.0
"""Voxels a second of the hand over the car, and voxels below the places where the ball would lie.
Larger: a faster, and a harder hand."""
CAR_SECONDS = 4.0
"""Length of the car's path, s. Longer: more of the car, and a longer run."""


class Case(NamedTuple):
    """A path: its name, poses (M, 4, 4) and forces (M, 3) of the coupling, one a millisecond."""

    name: str
    poses: Floats
    forces: Floats


class GrantedHand(SmoothHand):
    """The coupling as the server grants it: its caps, and no damper, which is the client's."""

    def __init__(self, ground: Ground, shell: PointShell, pose: Floats) -> None:
        super().__init__(ground, shell, pose, Terms())
        self.grant(CAP)


def case_of(name: str, ground: Ground, shell: PointShell, places: Floats) -> Case:
    """Feel a path of places (M, 3) on this machine."""
    poses = np.array([posed(place) for place in places])
    hand = GrantedHand(ground, shell, poses[0])
    return Case(name, poses, np.array([hand.step(pose, np.zeros(6)) for pose in poses]))


def closed_forms(folder: Path) -> tuple[str, PointShell, list[Case]]:
    """Environment, ball, and its ways over a plane, round an edge and through a groove."""
    axes = slope_axes(20.0)
    level, edge, groove = plane("plane", axes), convex_edge(axes), concave_corner(axes)
    shell = ball(BALL, SIZE, POINTS)
    high, above = (1.5 - DEPTH + BALL) * SIZE, np.array([0.0, 0.0, 0.008])
    far = 0.02
    ways = {
        level.name: straight(np.array([-far, 0.0, high]), np.array([far, 0.0, high]), SPEED),
        edge.name: way_round_edge(high, far)[0],
        groove.name: np.concatenate(
            [
                straight(np.array([high + far, 0.0, high]), np.array([high, 0.0, high]), SPEED),
                straight(np.array([high, 0.0, high]), np.array([high, 0.0, high + far]), SPEED),
            ]
        ),
    }
    names = {level.name: "plane", edge.name: "convex edge", groove.name: "groove"}
    with Ground.of_scenes(folder, [level, edge, groove], SIZE, distances=True) as ground:
        cases = []
        for name, way in ways.items():
            path = np.concatenate([straight(way[0] + above, way[0], SPEED), way])
            places = ground.origins[name] + path @ axes.T
            cases.append(case_of(names[name], ground, shell, places))
    (url,) = folder.glob("*.db")
    return str(url), shell, cases


def car(folder: Path) -> tuple[str, PointShell, list[Case], str]:
    """Environment of the car, a ball, its way over the largest parts, and the car's file."""
    data = os.environ.get("HAPTICDB_TEST_DATA")
    file = Path(data, CAR) if data else Path(write_sample(folder / "sample").car)
    url = str(folder / "car.db")
    options = ImportOptions(grid=GridOptions(bits=BITS, extent=EXTENT), distances=True)
    hapticdb.import_files(url, [file], options)
    with hapticdb.open(url, read_only=True) as env:
        size = env.grid.voxel_size
        shell = ball(BALL, size, POINTS)
        places = slide_poses(env, shell, 2000)[:, :3, 3]
    ways = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    at = np.arange(round(CAR_SECONDS * 1e3)) * 1e-3 * CAR_SPEED * size
    path = np.stack([np.interp(at, ways, places[:, axis]) for axis in range(3)], axis=1)
    path[:, 2] -= PRESSED * size * np.minimum(at / (10.0 * size), 1.0)
    with Ground(url, distances=True) as ground:
        for place in np.unique(np.round(path[::20] / size / 16.0), axis=0) * size * 16.0:
            ground.fetch(place, 40.0)
        case = case_of("car", ground, shell, path)
    return url, shell, [case], file.name


def quantiles(seconds: Sequence[float] | Floats) -> dict[str, float]:
    """Median and 99th percentile, s."""
    p50, p99 = np.quantile(np.asarray(seconds), [0.5, 0.99])
    return {"p50": float(p50), "p99": float(p99)}


def along(case: Case, port: int, seconds: float) -> Line:
    """Figures of a path in real time, with added latency."""
    near = np.zeros_like(case.forces)
    ages: list[float] = []
    waits: list[float] = []
    with (
        delayed(port, seconds) as relay_port,
        ContactProxy(f"ws://127.0.0.1:{relay_port}?token={TOKEN}", damping=0.0) as proxy,
    ):
        begun = time.monotonic()
        while (passed := time.monotonic() - begun) < READY_WITHIN:
            proxy.wrench(case.poses[0], np.zeros(6))
            if passed > 1.0 and proxy.told.is_fresh:  # the cells are there
                break
            time.sleep(1e-3)
        began, last = time.perf_counter(), 0
        for due in range(1, len(case.poses)):
            if due <= last:
                continue  # the machine was busy for longer than a period
            time.sleep(max(began + due * 1e-3 - time.perf_counter(), 0.0))
            n = min(int((time.perf_counter() - began) * 1e3), len(case.poses) - 1)
            start = time.perf_counter()
            near[last + 1 : n + 1] = proxy.wrench(case.poses[n], np.zeros(6))[:3]
            waits.append(time.perf_counter() - start)
            ages.append(min(proxy.told.age, 1e3))
            last = max(n, last)
        figures = proxy.figures()
    error = np.linalg.norm(near - case.forces, axis=1)
    force = np.linalg.norm(case.forces, axis=1)
    return {
        "path": case.name,
        "added": seconds,
        "round_trip": figures.round_trip,
        "age": quantiles(ages),
        "error": {"rms": float(np.sqrt((error**2).mean())), "max": float(error.max())},
        "force": {"rms": float(np.sqrt((force**2).mean())), "max": float(force.max())},
        "bytes": figures.bytes / max(figures.proxies, 1),
        "late": figures.late / max(figures.proxies, 1),
        "periods": len(waits) / len(case.poses),
        "client": quantiles(waits),
    }


def lines_of(
    url: str, shell: PointShell, cases: Sequence[Case], folder: Path
) -> tuple[list[Line], float]:
    """Figures of all paths in an environment, and the server's seconds for a proxy."""
    shell.save(folder / "ball.npz")
    program = str(TESTS / "contact_server.py")
    with subprocess.Popen(
        [sys.executable, program, url, str(folder / "ball.npz")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            port = int(process.stdout.readline())
            lines = []
            for case in cases:
                for seconds in LATENCIES:
                    lines.append(along(case, port, seconds))
                    print(json.dumps(lines[-1]), file=sys.stderr, flush=True)
            _, told = process.communicate(timeout=30)
        finally:
            process.kill()
    count, spent = told.split()[-2:]
    return lines, float(spent) / int(count)


def measure(folder: Path) -> Line:
    """Measure all lines; a record for JSON."""
    compile_missing(entries_for("import", "resident", "proxies", "proxy"))
    lines, times = [], []
    (folder / "forms").mkdir()
    for url, shell, cases, *_ in (closed_forms(folder / "forms"), found := car(folder)):
        more, spent = lines_of(url, shell, cases, folder)
        lines += more
        times.append(spent)
    return {
        **records.conditions(),
        "car": found[3],
        "points": POINTS,
        "server": max(times),
        "lines": lines,
    }


def main() -> None:
    """Measure, print the table, and write the figures to a file."""
    argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0]).parse_args()
    with tempfile.TemporaryDirectory(prefix="hapticdb-proxies-") as folder:
        found = measure(Path(folder))
    records.write(Path("results"), {"contact_proxies": found})
    page_tables.refill("docs/protocol.md", Path("results"))


if __name__ == "__main__":
    main()
