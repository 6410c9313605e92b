"""A session that mirrors the cells of a server, over a network that delays.

    HAPTICDB_TEST_DATA=DATA python benchmarks/remote_cells.py           # the vintage car
    python benchmarks/remote_cells.py --url car.db --busy               # a copy of one's own

The server is `hapticdb serve` in a process of its own. Between it and the client a relay adds 0, 10
and 50 ms to a round trip, half of them each way. A ball slides over the car at 1 kHz while somebody
edits the car. Beside each line: round trips of a bare WebSocket echo through such a relay. The
first line is the same session without a server.
"""

import argparse
import json
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

import hapticdb
from awake import awake
from delaying import DelayingRelay, echo_trips
from hapticdb import PointShell, Session
from hapticdb.bench import records
from hapticdb.bench.workload import slide_poses
from hapticdb.devices.scripted import Player
from hapticdb.kernels.rigid import poses_of
from hapticdb.recording.file import Recording
from hapticdb.recording.frame import State
from hapticdb.recording.replay import resident
from hapticdb.resident.table import HEARTBEAT
from hapticdb.sample import write_sample
from hapticdb.store.remote.store import RemoteStore
from report.remote_page import remote_table
from served import ServedProcess, car_or_sample

Floats = NDArray[np.float64]
Line = dict[str, Any]
LATENCIES = (None, 0.0, 0.010, 0.050)
"""Seconds added to a round trip; None is a session without a server."""
POINTS = 300
N_POSES = 2000
"""Poses of the way over the car. Larger: shorter steps."""
SPEED = 0.03
"""Speed of the hand along its way, m/s."""
RADIUS = 24.0
"""Radius of the ball, voxels."""
SECONDS = 12.0
"""Length of each line."""
SETTLING = 1.0
"""Seconds before the first edit: the first cells are fetched."""
EDITS = 20
"""Commits during a line; even, so that the car is at its end as at its beginning."""
QUESTIONS = 60
"""Round trips of a question without a body, and of the echo."""
LOOK = 0.002
"""Seconds between two looks at the session: the resolution of ages."""
BITS = 10
"""Bits an axis of the car's grid."""
LEAST_STEP = 1e-7
"""Metres that a pose counts at least, so that times grow."""


class Writer:
    """Moves a part that the tool does not meet, and notes when each commit was done."""

    def __init__(self, url: str, object_id: int) -> None:
        self.commits: dict[int, float] = {}
        self._end = threading.Event()
        self._given = url, object_id
        self._thread = threading.Thread(target=self._write)

    def _write(self) -> None:
        url, object_id = self._given
        with hapticdb.open(url) as env:
            poses = [env.object(object_id).transform, env.object(object_id).transform.copy()]
            poses[1][2, 3] += 3.0 * env.grid.voxel_size
            self._end.wait(SETTLING)
            for n in range(EDITS):
                env.move(object_id, poses[(n + 1) % 2])
                self.commits[env.store.revision()] = time.monotonic()
                self._end.wait((SECONDS - 2 * SETTLING) / EDITS)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(60.0)


def percentiles(times: "list[float] | Floats") -> Line:
    """Median, 99th percentile and greatest of times, s."""
    p50, p99, worst = np.percentile(np.asarray(times), [50, 99, 100]).tolist()
    return {"p50": p50, "p99": p99, "worst": worst}


def questions(url: str) -> Line:
    """Round trips of a question without a body."""
    trips = []
    with closing(RemoteStore(url)) as store:
        for n in range(QUESTIONS + 5):
            started = time.perf_counter()
            store.revision()
            if n >= 5:
                trips.append(time.perf_counter() - started)
    return percentiles(trips)


def far_object(url: str, poses: Floats) -> int:
    """Id of a small part as far from the way as there is."""
    with hapticdb.open(url, read_only=True) as env:
        objects = sorted(env.objects(), key=lambda obj: obj.voxels)[
            : max(len(env.objects()) // 2, 1)
        ]
    middle = poses[:, :3, 3]

    def distance(obj: hapticdb.Object) -> float:
        return float(np.linalg.norm(middle - obj.bounds.mean(axis=0), axis=1).min())

    return max(objects, key=distance).id


def errors(own: str, record: Path) -> Line:
    """Error of each recorded contact force against the engine on the spot at the same pose, N."""
    recording = Recording(record)
    frames = np.concatenate(list(recording.frames()))
    poses = np.empty((len(frames), 4, 4))
    poses_of(np.ascontiguousarray(frames["tool"]), poses)
    header = recording.header
    with (
        hapticdb.open(own, read_only=True) as env,
        resident(env, header.shell, header.law) as feel,
    ):
        wrenches, _ = feel(poses)
    off = np.linalg.norm(frames["wrench"][:, :3] - wrenches[:, :3], axis=1)
    is_held = (frames["state"] & State.HELD) != 0
    force = np.linalg.norm(wrenches[:, :3], axis=1)
    return {
        "rms": float(np.sqrt(np.mean(off**2))),
        "worst": float(off.max()),
        "worst_unheld": float(off[~is_held].max(initial=0.0)),
        "contact_frames": int((force > 0.0).sum()),
        "force_rms": float(np.sqrt(np.mean(force**2))),
    }


def watched(session: Session) -> tuple[dict[int, float], list[float]]:
    """Run a session; when each revision was first felt, and the ages of what was known."""
    felt: dict[int, float] = {}
    ages: list[float] = []
    control = session.cells.table.cells.control
    until = time.monotonic() + SECONDS
    while time.monotonic() < until:
        session.wait(LOOK)
        last = session.last()
        if last is not None:
            felt.setdefault(int(last["revision"][0]), time.monotonic())
            ages.append(1e-9 * (time.monotonic_ns() - int(control[HEARTBEAT])))
    return felt, ages


def line(own: str, url: str, shell: PointShell, poses: Floats, record: Path) -> Line:
    """Figures of one session along the way, of an environment at `url` that is at `own`, too."""
    way = np.concatenate([poses, poses[::-1]])
    steps = np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1)
    hand = Player(np.cumsum(np.append(0.0, np.maximum(steps, LEAST_STEP))) / SPEED, way, loops=True)
    editor = Writer(own, far_object(own, poses))
    with Session(url, shell, hand, record=record, has_baseline=False) as session:
        with editor:
            felt, ages = watched(session)
        report = session.stop()
    delays = [
        min(at for revision, at in felt.items() if revision >= commit) - committed
        for commit, committed in editor.commits.items()
        if any(revision >= commit for revision in felt)
    ]
    loop = report.loop
    return {
        "felt_after": percentiles(delays),
        "edits": len(delays),
        "age": percentiles(ages),
        "in_time": loop.frames / (loop.frames + loop.missed),
        "rate": loop.rate,
        "frames": loop.frames,
        "unknown_frames": report.unknown_frames,
        "held_frames": report.held_frames,
        "stale_frames": report.stale_frames,
        "contact_frames": report.contact_frames,
        "error": errors(own, record),
    }


def measure(folder: Path, given: argparse.Namespace) -> Line:
    """Measure all lines; a record for JSON."""
    sample = write_sample(folder / "sample")
    own = given.url or car_or_sample(folder, sample.car, BITS)
    with hapticdb.open(own, read_only=True) as env:
        shell = PointShell.sphere(RADIUS * env.grid.voxel_size, POINTS)
        poses = slide_poses(env, shell, N_POSES)
    lines = []
    with ServedProcess(own, folder) as server:
        for n, added in enumerate(LATENCIES):
            one: Line = {"added": added, "echo": None, "question": None}
            with ExitStack() as stack:
                url = own
                if added is not None:
                    relay = stack.enter_context(DelayingRelay(server.port, added))
                    url = server.device_url(relay.port)
                    one["echo"] = percentiles(echo_trips(added, QUESTIONS))
                    one["question"] = questions(url)
                one |= line(own, url, shell, poses, folder / f"{n}.hdbrec")
            lines.append(one)
            print(json.dumps(one), file=sys.stderr, flush=True)
    return {
        **records.conditions(),
        "environment": Path(own).stem,
        "points": len(shell),
        "speed": SPEED,
        "seconds": SECONDS,
        "is_busy": given.busy,
        "lines": lines,
    }


def main() -> None:
    """Measure, print the table, and write the figures to a file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--url", help="of an environment in a file that may be written")
    parser.add_argument("--busy", action="store_true", help="note that other work runs, too")
    parser.add_argument("--out", type=Path, default=Path("results/remote_cells.json"))
    given = parser.parse_args()
    with awake(), tempfile.TemporaryDirectory(prefix="hapticdb-remote-") as folder:
        found = measure(Path(folder), given)
    print(remote_table(found))
    given.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
