"""How soon a running session feels what another process commits.

A writer in its own process lifts an object that the tool slides along and puts it back, again and
again. This process looks, twice a millisecond, at the revision of the session's last frame.
"""

import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path as FilePath
from typing import Any

import numpy as np

import hapticdb
from hapticdb import PointShell, Session
from hapticdb.devices.scripted import Path
from hapticdb.poses import read_poses

RATE = 1000.0
"""Frames a second of the session."""
LIFT = 5.0
"""Height in voxels by which the object is lifted."""
LOOK = 0.0005
"""Seconds between two looks at the last frame: the resolution of the measured times."""
PAUSE = 0.2
"""Seconds before each edit."""
TIMEOUT = 60.0
"""Seconds that one edit may take before the run fails."""


def touched_object(url: str, shell: PointShell, path: FilePath) -> int:
    """Id of the object that the tool hits at most poses of the path."""
    with hapticdb.open(url, read_only=True) as env:
        met = [obj.id for pose in read_poses(path) for obj in env.touch(shell, pose).objects]
    return Counter(met).most_common(1)[0][0]


def write(url: str, object_id: int, n_edits: int) -> None:
    """Lift or lower the object at each line of input; print revision, time and duration."""
    with hapticdb.open(url) as env:
        poses = [env.object(object_id).transform, env.object(object_id).transform.copy()]
        poses[1][2, 3] += LIFT * env.grid.voxel_size
        for n in range(n_edits):
            if not sys.stdin.readline():
                return
            started = time.monotonic()
            env.move(object_id, poses[(n + 1) % 2])
            committed = time.monotonic()
            print(env.store.revision(), committed, committed - started, flush=True)


def edits(url: str, tool: FilePath, path: FilePath, n_edits: int) -> dict[str, Any]:
    """Milliseconds from a commit to a frame of its revision; at the end the object is put back."""
    shell = PointShell.from_file(tool, 300)
    object_id = touched_object(url, shell, path)
    delays, took = [], []
    command = [sys.executable, __file__, url, str(object_id), str(n_edits)]
    hand = Path(path, speed=0.2, loops=True)
    with (
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as writer,
        Session(url, shell, hand, rate=RATE) as session,
    ):
        assert writer.stdin is not None
        assert writer.stdout is not None
        late = threading.Timer(n_edits * TIMEOUT, writer.kill)  # ends `readline` below
        late.daemon = True
        late.start()
        for _ in range(n_edits):
            session.wait(PAUSE)
            before = revision_of(session)
            print(file=writer.stdin, flush=True)
            seen = until_after(session, before)
            revision, committed, seconds = map(float, writer.stdout.readline().split())
            assert revision_of(session) == revision, "each edit is one write"
            delays.append(1e3 * (seen - committed))
            took.append(seconds)
        late.cancel()
        report = session.stop()
    with hapticdb.open(url, read_only=True) as env:
        voxels = env.object(object_id).voxels
    p50, p90, worst = np.percentile(delays, [50, 90, 100])
    return {
        "edits": n_edits,
        "voxels": voxels,
        "seconds_of_a_move": float(np.median(took)),
        "latency_ms": {"p50": p50, "p90": p90, "worst": worst},
        "unknown_frames": report.unknown_frames,
    }


def revision_of(session: Session) -> int:
    """Revision of the last frame."""
    last = session.last()
    return -1 if last is None else int(last["revision"][0])


def until_after(session: Session, revision: int) -> float:
    """Wait for a frame of a later revision; the time at which it was seen, in seconds."""
    deadline = time.monotonic() + TIMEOUT
    while revision_of(session) <= revision:
        if time.monotonic() > deadline:
            raise SystemExit(f"no frame has a revision after {revision}")
        time.sleep(LOOK)
    return time.monotonic()


if __name__ == "__main__":
    write(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
