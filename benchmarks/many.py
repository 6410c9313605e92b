"""Many at once: readers that ask frame after frame while others write.

Each reader is a process with a connection of its own. Writers lift an object that the readers'
shell slides along and put it back. All tell times of one clock, so staleness can be told: from a
commit to the end of a reader's first frame that saw it. All processes are forked from one that has
loaded the kernels, and has no connection.
"""

import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hapticdb
from paper.workload import sphere_shell

Floats = NDArray[np.float64]
SETTINGS = {"shared_buffers": "1GB", "max_wal_size": "4GB"}
TIMEOUT = 300.0
"""Seconds in which a process must answer."""
LIFT = 5.0
"""Height in voxels by which a writer lifts an object."""
PAUSE = 0.05
"""Seconds between two edits of a writer."""


@dataclass(frozen=True)
class Effort:
    """Seconds of each measurement, numbers of readers, and of writers beside them."""

    seconds: float = 3.0
    readers: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    writers: tuple[int, ...] = (0, 2)


QUICK = Effort(0.5, (1, 4))


def read(env: hapticdb.Environment, poses: Floats, written: Sequence[int], end: float) -> Floats:
    """Frames until a time: begin, end and revision of each, (M, 3)."""
    shell, frames = sphere_shell(env.grid.voxel_size), list[tuple[float, float, float]]()
    while (began := time.monotonic()) < end:
        pose: Floats = poses[len(frames) % len(poses)]
        touch = env.touch(shell, pose, law="plane")
        ended = time.monotonic()
        revision = max(touch._known[i].revision for i in written)  # noqa: SLF001 - measured
        frames.append((began, ended, float(revision)))
    return np.array(frames).reshape(-1, 3)


def write(env: hapticdb.Environment, object_id: int, end: float) -> Floats:
    """Edits until a time: begin, end and revision of each, (M, 3); 0 where it was refused."""
    start, edits = env.object(object_id).transform, list[tuple[float, float, float]]()
    lifted = start.copy()
    lifted[2, 3] += LIFT * env.grid.voxel_size
    while (began := time.monotonic()) < end:
        try:
            moved = env.move(object_id, start if len(edits) % 2 else lifted)
            revision = float(moved.revision)
        except hapticdb.errors.DatabaseError:
            revision = 0.0
        edits.append((began, time.monotonic(), revision))
        time.sleep(PAUSE)
    env.move(object_id, start)
    return np.array(edits).reshape(-1, 3)


def work(pipe: Connection, url: str, poses: Floats | None, objects: Sequence[int]) -> None:
    """A process that reads along poses, or moves the first object: a time in, times out.

    Messages are float64s.
    """
    with hapticdb.open(url, read_only=poses is not None) as env:
        shell = sphere_shell(env.grid.voxel_size)
        if poses is not None:
            env.touch(shell, poses[0], law="plane")
        pipe.send_bytes(b"")  # ready
        while pipe.poll(TIMEOUT):
            (end,) = np.frombuffer(pipe.recv_bytes())
            if poses is None:
                pipe.send_bytes(write(env, objects[0], end).tobytes())
            else:
                pipe.send_bytes(read(env, poses, objects, end).tobytes())


def answers(pipes: Sequence[Connection]) -> list[Floats]:
    """What each process says next, (M, 3)."""
    for pipe in pipes:
        if not pipe.poll(TIMEOUT):
            raise SystemExit("a process did not answer")
    return [np.frombuffer(pipe.recv_bytes()).reshape(-1, 3) for pipe in pipes]


def touched_objects(url: str, poses: Floats, count: int) -> list[int]:
    """Ids of the objects that the shell touches at most poses, the smaller ones first."""
    with hapticdb.open(url, read_only=True) as env:
        shell = sphere_shell(env.grid.voxel_size)
        met = {obj.id: obj for pose in poses for obj in env.touch(shell, pose, law="plane").objects}
        return sorted(met, key=lambda i: met[i].voxels)[:count]


def seen_after(frames: Floats, edits: Floats) -> Floats:
    """Seconds from each commit to the end of a reader's first frame that saw it; 0 at least."""
    revisions = np.maximum.accumulate(frames[:, 2])
    made = edits[edits[:, 2] > 0]
    first = np.searchsorted(revisions, made[:, 2])
    is_seen = first < len(frames)
    return np.asarray(np.maximum(frames[first[is_seen], 1] - made[is_seen, 1], 0.0))


def summary(frames: Sequence[Floats], edits: Sequence[Floats], seconds: float) -> dict[str, Any]:
    """Rates and times, ms, of all readers and writers of one measurement."""
    every, made = np.concatenate(frames), np.concatenate([*edits, np.empty((0, 3))])
    took, wrote = every[:, 1] - every[:, 0], made[:, 1] - made[:, 0]
    cell: dict[str, Any] = {"readers": len(frames), "writers": len(edits)}
    cell |= {"frames_per_s": len(every) / seconds, "slowest_reader": min(map(len, frames))}
    figures: Mapping[str, Floats] = {"frame": took}
    if len(made):
        seen = np.concatenate([seen_after(own, made) for own in frames])
        figures = {"frame": took, "stale": seen, "edit": wrote}
        cell |= {"edits_per_s": len(made) / seconds, "refused": int((made[:, 2] == 0).sum())}
    for name, times in figures.items():
        for share in (50, 99, 100) if len(times) else ():
            cell[f"{name}_p{share}_ms"] = 1e3 * float(np.percentile(times, share))
    return cell


def measure(url: str, poses: Floats, effort: Effort) -> list[dict[str, Any]]:
    """Cells of all numbers of readers, without and with writers, from a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "poses.npy")
        np.save(path, poses)
        line = [sys.executable, __file__, url, str(path), json.dumps(asdict(effort))]
        done = subprocess.run(line, check=True, stdout=subprocess.PIPE, timeout=10 * TIMEOUT)
    cells: list[dict[str, Any]] = json.loads(done.stdout)
    return cells


def cells_of(url: str, poses: Floats, effort: Effort) -> list[dict[str, Any]]:
    """The same, in this process."""
    objects = touched_objects(url, poses[:100], max(effort.writers))
    context = multiprocessing.get_context("fork")
    with hapticdb.open(url, read_only=True) as env:
        engine = env.engine
    started, pipes = [], []
    # each reader begins at another pose
    tasks: list[tuple[Floats | None, Sequence[int]]] = [
        (np.roll(poses, 37 * n, axis=0), objects) for n in range(max(effort.readers))
    ]
    for path, mine in [*tasks, *((None, [i]) for i in objects)]:
        here, there = context.Pipe()
        process = context.Process(target=work, args=(there, url, path, mine), daemon=True)
        process.start()
        started.append(process)
        pipes.append(here)
    readers, writers = pipes[: len(tasks)], pipes[len(tasks) :]
    try:
        answers(pipes)
        cells = []
        for n_writers in effort.writers:
            for n_readers in effort.readers:
                asked = [*readers[:n_readers], *writers[:n_writers]]
                end = time.monotonic() + effort.seconds
                for pipe in asked:
                    pipe.send_bytes(np.float64(end).tobytes())
                found = answers(asked)
                cell = summary(found[:n_readers], found[n_readers:], effort.seconds)
                cells.append({"engine": engine} | cell)
        return cells
    finally:
        for process in started:
            process.kill()
            process.join(TIMEOUT)


if __name__ == "__main__":
    address, file, asked = sys.argv[1:]
    print(json.dumps(cells_of(address, np.load(file), Effort(**json.loads(asked)))))
