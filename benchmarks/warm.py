"""What a user waits for once everything is compiled and kept: processor and wall time of verbs.

    python benchmarks/warm.py [--old CHECKOUT] [--rounds 9]

Each verb runs on the sample in a process of its own. With another checkout, the two take turns.
Processor time is of the process and of those that it has waited for: the reader of a tool's file
and the fork server, not the loop of `feel`.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import page_tables
import records
from hapticdb.sample import write_sample

LONGEST_S = 600.0
"""Seconds after which a verb counts as hung."""
IMPORT = ("import", "car.db", "../car.glb", "--bits", "9", "--extent", "1.6")
VERBS = {
    "info": ("info", "car.db"),
    "touch": ("touch", "car.db", "--tool", "../spanner.stl", "--poses", "../path.csv"),
    "sweep": ("sweep", "car.db", "--part", "body/hood", "--path", "../up.csv"),
    "feel": (
        "feel", "car.db", "--tool", "../spanner.stl", "--device", "../path.csv", "--seconds", "0.2",
    ),
}  # fmt: skip
UP = "x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0\n0,0,0.3,1,0,0,0\n"


def timed(folder: Path, checkout: Path, *words: str) -> tuple[float, float]:
    """Processor and wall time of a verb of a checkout, seconds."""
    # modules are compiled once, as for a user, and not beside either checkout's sources
    env = os.environ | {
        "PYTHONPATH": str(checkout / "src"),
        "PYTHONPYCACHEPREFIX": str(folder / "pyc"),
    }
    env.pop("PYTHONDONTWRITEBYTECODE", None)
    before, began = _busy(), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "hapticdb", *words],
        cwd=folder, env=env, capture_output=True, text=True, check=False, timeout=LONGEST_S,
    )  # fmt: skip
    wall = time.perf_counter() - began
    if done.returncode not in {0, 1}:  # 1: the hood hits the windscreen
        raise SystemExit(f"{' '.join(words)}: {done.stderr}")
    return _busy() - before, wall


def _busy() -> float:
    """Processor time of this process's children that have ended, seconds."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def measure(folder: Path, sides: dict[str, Path], rounds: int) -> list[dict[str, Any]]:
    """Medians of each verb on each side; a first, untimed run compiles and keeps."""
    write_sample(folder)
    (folder / "up.csv").write_text(UP)
    cells = []
    for side, checkout in sides.items():
        (folder / side).mkdir()
        timed(folder / side, checkout, *IMPORT)
    for name, words in VERBS.items():
        for side, checkout in sides.items():
            timed(folder / side, checkout, *words)
        turns = [
            {side: timed(folder / side, checkout, *words) for side, checkout in sides.items()}
            for _ in range(rounds)
        ]
        for side in sides:
            busy, wall = (statistics.median(turn[side][n] for turn in turns) for n in (0, 1))
            cells.append({"verb": name, "side": side, "cpu_s": busy, "wall_s": wall})
            print(f"{name:6} {side:4} {busy:6.2f} s of processor time, {wall:6.2f} s", flush=True)
    return cells


def main() -> None:
    """Measure, write results/warm.json, and fill the page's table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--old", type=Path, help="another checkout, measured in turns")
    parser.add_argument("--rounds", type=int, default=9)
    asked = parser.parse_args()
    sides = {"this": records.ROOT} | ({"old": asked.old.resolve()} if asked.old else {})
    with tempfile.TemporaryDirectory(prefix="hapticdb-warm-") as folder:
        cells = measure(Path(folder), sides, asked.rounds)
    load = ", ".join(f"{load:.1f}" for load in os.getloadavg())
    inputs = {"rounds": asked.rounds, "load": f"{load} at the end"}
    out = records.ROOT / "results"
    records.write(out, {"warm": records.result("warm", cells, inputs)})
    page_tables.refill("docs/evaluation.md", out, None)


if __name__ == "__main__":
    main()
