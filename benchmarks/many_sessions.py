"""Many sessions on this machine's processors: how many keep their rate, and what each one adds.

    python benchmarks/many_sessions.py                     # the sample car, 300 points, 1 kHz
    python benchmarks/many_sessions.py --url car.db --busy # an environment; the machine does more

Hands slide over the car, moved 30 times a second, each at a place of its own. 1, 4, 16 and 64 of
them are hosted (`hapticdb.hosting`), and a few have sessions of their own (`hapticdb.realtime`),
which are two processes each without their share of the cells.
"""

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hapticdb
from hapticdb import GridOptions, ImportOptions, PointShell
from hapticdb.bench import records
from hapticdb.bench.workload import slide_poses
from hapticdb.devices.scripted import Player
from hapticdb.hosting.host import SessionHost
from hapticdb.hosting.hosted import HostedSession
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.realtime.session import Session
from hapticdb.sample import write_sample
from report.hosting_page import hosted_table

Floats = NDArray[np.float64]
Line = dict[str, Any]
COUNTS = (1, 4, 16, 64)
OWN_COUNTS = (1, 4)
"""Numbers of sessions: hosted ones, and ones with processes of their own. Larger: longer runs."""
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


def processor_seconds(pid: int) -> float:
    """Processor time of a process so far, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


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


@contextlib.contextmanager
def hosted(url: str, shell: PointShell, poses: Floats, count: int) -> Iterator[Line]:
    """So many hosted sessions, begun and settled; yields a record to be filled."""
    with SessionHost(url) as host:
        starts = [poses[(n * len(poses) // count) % len(poses)] for n in range(count)]
        sessions = [host.begin(shell, start) for start in starts]
        hands = Hands(poses, sessions)
        hands.move(SETTLING)
        yield {"host": host, "sessions": sessions, "hands": hands}


def hosted_line(url: str, shell: PointShell, poses: Floats, count: int, seconds: float) -> Line:
    """Figures of so many hosted sessions."""
    with hosted(url, shell, poses, count) as one:
        host, sessions = one["host"], one["sessions"]
        fetcher = host.cells[0].pid
        before = [session.figures() for session in sessions]
        worked = [processor_seconds(pid) for pid in [*host.pids, fetcher]]
        started = time.monotonic()
        one["hands"].move(seconds)
        passed = time.monotonic() - started
        after = [session.figures() for session in sessions]
        worked = [
            (processor_seconds(pid) - was) / passed
            for pid, was in zip([*host.pids, fetcher], worked, strict=True)
        ]
        frames = np.array([b.frames - a.frames for a, b in zip(before, after, strict=True)])
        in_time = np.array(
            [
                (b.in_time * (b.frames + b.missed) - a.in_time * (a.frames + a.missed))
                / max(b.frames + b.missed - a.frames - a.missed, 1)
                for a, b in zip(before, after, strict=True)
            ]
        )
        contacts = [bool(last["contacts"][0]) for s in sessions if (last := s.latest()) is not None]
        cache = host.cells[0].figures()
        return {
            "kind": "hosted",
            "sessions": count,
            "workers": len(host.pids),
            "rate": float(np.median(frames)) / passed,
            "least_rate": float(frames.min()) / passed,
            "in_time": float(np.median(in_time)),
            "least_in_time": float(in_time.min()),
            "lateness": {
                "p50": float(np.median([one.lateness.p50 for one in after])),
                "p99": float(np.median([one.lateness.p99 for one in after])),
            },
            "elapsed": {
                "p50": float(np.median([one.elapsed.p50 for one in after])),
                "p99": float(np.median([one.elapsed.p99 for one in after])),
            },
            "unknown_share": float(sum(one.unknown for one in after) / max(frames.sum(), 1)),
            "touching": sum(contacts),
            "hit_rate": cache.hit_rate,
            "worker_load": sum(worked[:-1]),
            "fetching_load": worked[-1],
            "worker_mb": sum(megabytes(pid) for pid in host.pids),
            "fetching_mb": megabytes(fetcher),
        }


def own_line(url: str, shell: PointShell, poses: Floats, count: int, seconds: float) -> Line:
    """Figures of so many sessions with a process each, over shared cells."""
    way = np.concatenate([poses, poses[::-1]])
    times = np.arange(len(way)) / ARRIVALS
    with ResidentCells(url) as cells, contextlib.ExitStack() as stack:
        sessions = [
            stack.enter_context(
                Session(
                    cells, shell,
                    Player(times, np.roll(way, -n * len(way) // count, axis=0), loops=True),
                    has_baseline=False,
                )
            )
            for n in range(count)
        ]  # fmt: skip
        until = time.monotonic() + SETTLING + seconds
        while time.monotonic() < until:
            for session in sessions:
                session.wait(0.01)
        used = [megabytes(session.pid) for session in sessions]
        done = [session.stop() for session in sessions]
    loops = [report.loop for report in done]
    shares = [loop.frames / (loop.frames + loop.missed) for loop in loops]
    return {
        "kind": "own process",
        "sessions": count,
        "workers": count,
        "rate": float(np.median([loop.rate for loop in loops])),
        "least_rate": min(loop.rate for loop in loops),
        "in_time": float(np.median(shares)),
        "least_in_time": min(shares),
        "lateness": {
            name: float(np.median([getattr(loop.lateness, name) for loop in loops]))
            for name in ("p50", "p99")
        },
        "elapsed": {
            name: float(np.median([getattr(loop.elapsed, name) for loop in loops]))
            for name in ("p50", "p99")
        },
        "unknown_share": sum(r.unknown_frames for r in done) / sum(one.frames for one in loops),
        "touching": sum(report.contact_frames > 0 for report in done),
        "worker_mb": sum(used),
    }


def measure(folder: Path, given: argparse.Namespace) -> Line:
    """Measure all lines; a record for JSON."""
    sample = write_sample(folder / "sample")
    url = given.url
    if url is None:
        url = str(folder / "sample.db")
        options = ImportOptions(grid=GridOptions(bits=BITS, extent=EXTENT))
        hapticdb.import_files(url, [sample.car], options)
    shell = PointShell.from_file(sample.wrench, points=POINTS)
    with hapticdb.open(url, read_only=True) as env:
        poses = slide_poses(env, shell, N_POSES)
    lines = []
    for measured, counts in ((hosted_line, COUNTS), (own_line, OWN_COUNTS)):
        for count in counts:
            lines.append(measured(url, shell, poses, count, given.seconds))
            print(json.dumps(lines[-1]), file=sys.stderr, flush=True)
    return {
        **records.conditions(),
        "environment": Path(url).name,
        "points": len(shell),
        "arrivals": ARRIVALS,
        "is_busy": given.busy,
        "processors": os.cpu_count(),
        "lines": lines,
    }


def main() -> None:
    """Measure, print the figures, and write them to a file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--url", help="of an environment; the sample car unless given")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each line")
    parser.add_argument("--busy", action="store_true", help="note that other work runs, too")
    parser.add_argument("--out", type=Path, default=Path("results/many_sessions.json"))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="hapticdb-many-") as folder:
        found = measure(Path(folder), given)
    print(hosted_table(found))
    given.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
