"""A session on a server that is killed, cut off and made to err, for as long as one likes.

    python benchmarks/endurance.py --minutes 10

The sample car is imported into a private PostgreSQL server in a temporary folder, and a hand slides
a spanner over it at 1 kHz. At random times the server is killed and started again later, its
backends are terminated, the fetching process is killed, and statements fail. The script asserts
that nothing crashes, that no force is left while the database is away, and that frames are exact
again afterwards. It prints one JSON object.
"""

import argparse
import json
import math
import os
import signal
import tempfile
import threading
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psycopg
from numpy.typing import NDArray

import hapticdb
from erring import erring
from hapticdb import GridOptions, ImportOptions, PointShell
from hapticdb.devices.scripted import Path as HandPath
from hapticdb.poses import read_poses, write_poses
from hapticdb.realtime.report import Report
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.realtime.session import Session
from hapticdb.recording.file import Recording
from hapticdb.recording.frame import State
from hapticdb.recording.replay import replay
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.sample import write_sample
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.private_server import PrivateServer

STALENESS = 0.5
"""Seconds without an answer of the database after which resident cells count as unknown."""
FALLING = 0.04
"""Seconds after which a held force is zero."""
SPARE = 0.02
"""Seconds of tolerance for a frame that a busy machine begins late."""
APART = (2.0, 6.0)
AWAY = (1.0, 5.0)
"""Ranges in seconds: between two disturbances, and for which the server stays away."""
RECOVERY_PATIENCE = 30.0
"""Seconds after a disturbance within which a frame must be exact again."""

Frames = NDArray[np.void]


class Trouble(NamedTuple):
    """A disturbance: kind, begin and end, and until when the server was surely away (seconds)."""

    kind: str
    begun: float
    ended: float
    away_until: float


class Course:
    """A session, and what happens to its server meanwhile."""

    def __init__(self, session: Session, url: str, server: PrivateServer | None, seed: int) -> None:
        self.session, self.server = session, server
        self.conninfo = parse(url).conninfo
        self.rng = np.random.default_rng(seed)
        self.troubles: list[Trouble] = []
        self.away_until = 0.0
        self.kinds = [self.kill_server] if server else []
        self.kinds += [self.terminate_backends, self.kill_fetching]
        self.started = min(self.start_by_last_frame() for _ in range(100))

    def start_by_last_frame(self) -> float:
        """Start of the session's time, from its last frame; too late by that frame's lateness."""
        self.look_after(2e-3)
        last = self.session.last()
        return time.monotonic() - (float(last["time"][0]) if last is not None else 0.0)

    def now(self) -> float:
        """Seconds since the session's start, on the recording's time scale."""
        return time.monotonic() - self.started

    def run(self, seconds: float) -> None:
        """Cause one disturbance after another, of each kind in turn, at random moments."""
        while self.now() < seconds:
            self.look_after(self.rng.uniform(*APART))
            trouble = self.kinds[len(self.troubles) % len(self.kinds)]
            begun = self.now()
            trouble()
            self.troubles.append(Trouble(trouble.__name__, begun, self.now(), self.away_until))
        self.look_after(max(*APART))

    def look_after(self, seconds: float) -> None:
        """Let so many seconds pass; the session must go on."""
        assert self.session.wait(seconds) is None, "the session has ended by itself"

    def kill_server(self) -> None:
        """End the server as a crash does, and start it again later."""
        assert self.server is not None
        self.server.kill()
        self.look_after(self.rng.uniform(*AWAY))
        self.away_until = self.now()  # the server answers before `start` returns
        starting = threading.Thread(target=self.server.start)  # frames go on meanwhile
        starting.start()
        while starting.is_alive():
            self.look_after(0.05)

    def terminate_backends(self) -> None:
        """Cut every connection."""
        with psycopg.connect(self.conninfo, autocommit=True) as connection:
            connection.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
                "WHERE pid <> pg_backend_pid() AND backend_type = 'client backend'"
            )

    def kill_fetching(self) -> None:
        """End the fetching process; `Session.wait` starts another."""
        os.kill(self.session.cells.pid, signal.SIGKILL)


def is_exact(frames: Frames) -> NDArray[np.bool_]:
    """Whether each frame is exact: neither held nor with unknown points."""
    found: NDArray[np.bool_] = (frames["state"] & State.HELD == 0) & (frames["unknown"] == 0)
    return found


def held_for(frames: Frames) -> NDArray[np.float64]:
    """Seconds (n,) for which each frame's wrench had been held."""
    is_held = frames["state"] & State.HELD > 0
    total = np.cumsum(frames["dt"])
    before = np.maximum.accumulate(np.where(is_held, 0.0, total))
    held: NDArray[np.float64] = np.where(is_held, total - before, 0.0)
    return held


def outage(trouble: Trouble, until: float, frames: Frames) -> dict[str, object]:
    """Effect of one disturbance on the recording, until the next; times in seconds.

    until_zero : from its begin until the force has fallen, None if the force never fell;
    until_exact : from its end to the first frame after which all are exact, 0 if all were exact.
    """
    times = frames["time"]
    within = (times >= trouble.begun) & (times < until)
    silent = np.flatnonzero(within & ~is_exact(frames))
    fallen = np.flatnonzero(within & (held_for(frames) >= FALLING))
    n_last = min(int(silent[-1]) + 1, len(frames) - 1) if len(silent) else 0
    return {
        "kind": trouble.kind,
        "at": trouble.begun,
        "away": trouble.ended - trouble.begun,
        "held_frames": len(silent),
        "until_zero": float(times[fallen[0]] - trouble.begun) if len(fallen) else None,
        "until_exact": max(float(times[n_last] - trouble.ended), 0.0) if len(silent) else 0.0,
    }


def check(troubles: list[Trouble], frames: Frames) -> None:
    """Assert the rules that hold after any disturbance."""
    times = frames["time"]
    assert np.isfinite(frames["applied"]).all()
    is_fallen = held_for(frames) >= FALLING + 1e-9  # the loop rounds the same sums differently
    assert not frames["applied"][is_fallen].any()
    for trouble in troubles:
        after = (times >= trouble.ended) & (times <= trouble.ended + RECOVERY_PATIENCE)
        assert is_exact(frames)[after].any(), f"no recovery after {trouble}"
        if trouble.kind != "kill_server":
            continue
        # staleness counts from the last answer, which may come after `begun`
        silent = trouble.begun + STALENESS + FALLING + SPARE
        is_away = (times >= silent) & (times < trouble.away_until)
        # from the third frame on: the fall counts periods, and a period may be long here
        assert not frames["applied"][np.flatnonzero(is_away)[2:]].any(), f"force during {trouble}"


def check_exact(path: Path, url: str) -> int:
    """Replay every exact frame and compare bit for bit; the number of frames."""
    recording = Recording(path)
    with hapticdb.open(url, read_only=True) as env:
        felt = ResidentFrames(Residency(env.store, CellTable.create()), recording.header.shell)
        replayed = replay(recording, env, felt.wrenches)
    assert replayed.is_equal, replayed.describe()
    return replayed.n_compared


def summary(report: Report, troubles: list[Trouble], frames: Frames) -> dict[str, object]:
    """Figures of the session and of each disturbance, to print."""
    ends = [trouble.begun for trouble in troubles[1:]] + [math.inf]
    outages = [outage(*pair, frames) for pair in zip(troubles, ends, strict=True)]
    assert report.empty is not None  # the session measures an empty loop by default
    return {
        "frames": report.loop.frames,
        "missed": report.loop.missed,
        "lateness": report.loop.lateness._asdict(),
        "empty_lateness": report.empty.lateness._asdict(),
        "hit_frames": report.hit_frames,
        "held_frames": report.held_frames,
        "stale_frames": report.stale_frames,
        "unknown_frames": report.unknown_frames,
        "losses": report.cache.losses,
        "restarts": report.cache.restarts,
        "cache": report.cache._asdict(),
        "outages": outages,
        "worst_until_exact": max((float(str(o["until_exact"])) for o in outages), default=0.0),
    }


def run(args: argparse.Namespace, folder: Path, url: str, server: PrivateServer | None) -> None:
    """Run a session with disturbances, check it, and print its figures."""
    files = write_sample(folder)
    shell = PointShell.from_file(files.wrench)
    there = read_poses(files.path)
    write_poses(folder / "loop.csv", np.concatenate([there, there[::-1]]))
    hand = HandPath(folder / "loop.csv", speed=args.speed, loops=True)
    wrap = partial(erring, share=args.errors, seed=args.seed)
    path = folder / "endurance.hdbrec"
    with (
        ResidentCells(url, wrap=wrap) as cells,
        Session(cells, shell, hand, rate=args.rate, staleness=STALENESS, record=path) as session,
    ):
        course = Course(session, url, server, args.seed)
        course.run(60.0 * args.minutes)
        report = session.stop()
    frames = np.concatenate(list(Recording(path).frames()))
    assert report.lost_records == 0
    assert report.recording_ended is None, report.recording_ended
    check(course.troubles, frames)
    figures = summary(report, course.troubles, frames)
    figures["replayed"] = check_exact(path, url)
    print(json.dumps(figures, allow_nan=False))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=1000.0, help="Hz")
    parser.add_argument("--speed", type=float, default=0.3, help="of the hand, m/s")
    parser.add_argument("--errors", type=float, default=0.002, help="share of round trips")
    parser.add_argument("--bits", type=int, default=11, help="of the grid")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--url", help="an environment on another server, which is not killed; it holds the sample"
    )
    args = parser.parse_args()
    hapticdb.warm_up()  # compiling must not take longer than the time without errors (`GRACE`)
    with tempfile.TemporaryDirectory(prefix="hapticdb-endurance-") as name:
        folder = Path(name)
        if args.url:
            run(args, folder, args.url, None)
            return
        server = PrivateServer.at(folder / "server")
        server.start()
        try:
            options = ImportOptions(grid=GridOptions(bits=args.bits))
            hapticdb.import_files(server.conninfo(), [write_sample(folder).car], options)
            run(args, folder, server.conninfo(), server)
        finally:
            server.stop()


if __name__ == "__main__":
    main()
