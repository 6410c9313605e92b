"""Many sessions on this machine's processors: how many keep their rate, and what each one adds.

    python benchmarks/many_sessions.py

Hands slide over the car, moved 30 times a second, each at a place of its own. 1, 4, 16 and 64 of
them are hosted (`hapticdb.hosting`).
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hapticdb
import pages
import records
from hapticdb import GridOptions, ImportOptions, PointShell
from hapticdb.hosting.host import SessionHost
from hapticdb.hosting.hosted import HostedSession
from hapticdb.sample import write_sample
from paper.workload import slide_poses

Floats = NDArray[np.float64]
Line = dict[str, Any]
COUNTS = (1, 4, 16, 64)
"""Numbers of sessions. Larger: longer runs."""
POINTS = 300
N_POSES = 4000
"""Poses of the way over the car. Larger: shorter steps, and slower hands."""
ARRIVALS = 30.0
"""Poses of each hand a second, as a browser sends them. Larger: more work outside the workers."""
SETTLING = 3.0
"""Seconds before the figures count: cells are fetched for all. Larger: longer runs."""
BITS, EXTENT = 11, 1.6
"""Grid: bits an axis, and its edge as a multiple of the model's longest side."""


def megabytes(pid: int) -> float:
    """Memory of a process, shared pages by their share (PSS), MB."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    (pss,) = [line for line in lines if line.startswith("Pss:")]
    return int(pss.split()[1]) / 1e3


class Hands:
    """Hands that slide over the car, each from a place of its own, there and back."""

    def __init__(self, poses: Floats, sessions: list[HostedSession]) -> None:
        self._way = np.concatenate([poses, poses[::-1]])
        self._sessions = sessions

    def move(self, seconds: float) -> None:
        """Move all hands for a time."""
        started = time.monotonic()
        step = 0
        while (passed := time.monotonic() - started) < seconds:
            for n, session in enumerate(self._sessions):
                at = (n * len(self._way) // len(self._sessions) + step) % len(self._way)
                session.move(self._way[at])
            step += 1
            time.sleep(max(step / ARRIVALS - passed, 0.0))


def hosted_line(url: str, shell: PointShell, poses: Floats, count: int, seconds: float) -> Line:
    """Figures of so many hosted sessions, once they have settled."""
    with SessionHost(url) as host:
        starts = [poses[(n * len(poses) // count) % len(poses)] for n in range(count)]
        sessions = [host.begin(shell, start) for start in starts]
        hands = Hands(poses, sessions)
        hands.move(SETTLING)
        before = [session.figures() for session in sessions]
        started = time.monotonic()
        hands.move(seconds)
        passed = time.monotonic() - started
        after = [session.figures() for session in sessions]
        frames = np.array([b.frames - a.frames for a, b in zip(before, after, strict=True)])
        in_time = np.array(
            [
                (b.in_time * (b.frames + b.missed) - a.in_time * (a.frames + a.missed))
                / max(b.frames + b.missed - a.frames - a.missed, 1)
                for a, b in zip(before, after, strict=True)
            ]
        )
        return {
            "sessions": count,
            "workers": len(host.pids),
            "rate": float(np.median(frames)) / passed,
            "in_time": float(np.median(in_time)),
            "least_in_time": float(in_time.min()),
            **{
                kind: {
                    share: float(np.median([getattr(getattr(one, kind), share) for one in after]))
                    for share in ("p50", "p99")
                }
                for kind in ("lateness", "elapsed")
            },
            "worker_mb": sum(megabytes(pid) for pid in host.pids),
        }


def measure(folder: Path, seconds: float) -> Line:
    """Measure all lines; a record for JSON."""
    sample = write_sample(folder / "sample")
    url = str(folder / "sample.db")
    options = ImportOptions(grid=GridOptions(bits=BITS, extent=EXTENT))
    hapticdb.import_files(url, [sample.car], options)
    shell = PointShell.from_file(sample.wrench, points=POINTS)
    with hapticdb.open(url, read_only=True) as env:
        poses = slide_poses(env, shell, N_POSES)
    lines = []
    for count in COUNTS:
        lines.append(hosted_line(url, shell, poses, count, seconds))
        print(json.dumps(lines[-1]), file=sys.stderr, flush=True)
    return {
        **records.conditions(),
        "points": len(shell),
        "arrivals": ARRIVALS,
        "processors": os.cpu_count(),
        "lines": lines,
    }


def main() -> None:
    """Measure, print the figures, and write them to a file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0, help="of each line")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="hapticdb-many-") as folder:
        found = measure(Path(folder), given.seconds)
    records.write(Path("results"), {"many_sessions": found})
    pages.refill("docs/realtime.md", Path("results"))


if __name__ == "__main__":
    main()
