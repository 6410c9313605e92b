"""An import onto several servers, and the rebalance after it, beside a reader and a writer.

    python benchmarks/shards_rebalance.py car.glb --bits 11 --out results/shards_rebalance.json

An import cuts the grid evenly, so its shards are not equal; a rebalance makes them so. Meanwhile
one process touches, and one writes an object again and again: what they wait is what a rebalance
costs.
All servers are private ones on this machine.
"""

import argparse
import atexit
import contextlib
import itertools
import json
import multiprocessing
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import hapticdb
from awake import awake
from hapticdb import GridOptions, ImportOptions
from hapticdb.bench import records
from hapticdb.bench.measure import summary
from hapticdb.bench.workload import sphere_shell
from hapticdb.demo import slide_along
from hapticdb.store.connect import open_store
from hapticdb.store.sharding import RebalanceProgress
from shards import again

TESTS = Path(__file__).parent.parent / "tests"
sys.path.insert(0, str(TESTS))

from children import received  # noqa: E402 - of the tests' folder

POSES = 400
BEFORE_S = 10.0
"""Seconds for which reader and writer work alone first."""
SPAWN = multiprocessing.get_context("spawn")
Times = list[tuple[float, float]]
"""Begin of each call, on the clock of all processes, and the microseconds that it took."""


def read(url: str, line: Connection) -> None:
    """Touch until a message comes; send the times of all frames."""
    found: Times = []
    with hapticdb.open(url, read_only=True) as env:
        shell = sphere_shell(env.grid.voxel_size)
        poses = slide_along(env, shell.points, POSES)
        for pose in poses:
            env.touch(shell, pose, strategy="array", law="plane")
        line.send("ready")
        while not line.poll():
            started = time.monotonic()
            env.touch(shell, poses[len(found) % POSES], strategy="array", law="plane")
            found.append((started, (time.monotonic() - started) * 1e6))
    line.send(found)


def write(url: str, line: Connection) -> None:
    """Write one object again and again until a message comes; send the times of all writes."""
    found: Times = []
    with hapticdb.open(url) as env:
        by_size = sorted(env.objects(), key=lambda obj: obj.voxels)
        object_id = by_size[len(by_size) // 2].id
        env.store.replace(*again(env, object_id))
        line.send("ready")
        while not line.poll(0.05):
            arguments = again(env, object_id)
            started = time.monotonic()
            env.store.replace(*arguments)
            found.append((started, (time.monotonic() - started) * 1e6))
    line.send(found)


@contextlib.contextmanager
def beside(url: str) -> Iterator[dict[str, Times]]:
    """A reader and a writer at work; their times stand in the dictionary afterwards."""
    found: dict[str, Times] = {}
    lines = {}
    for name, work in (("reader", read), ("writer", write)):
        ours, theirs = SPAWN.Pipe()
        SPAWN.Process(target=work, args=(url, theirs), daemon=True).start()
        lines[name] = ours
        received(ours)
    yield found
    for name, line in lines.items():
        line.send("end")
        found[name] = received(line)


def rebalanced(url: str) -> dict[str, Any]:
    """Rebalance beside a reader and a writer."""
    told: list[tuple[float, RebalanceProgress]] = []
    with beside(url) as times:
        threading.Event().wait(BEFORE_S)
        began = time.monotonic()
        report = hapticdb.rebalance_environment(
            url, progress=lambda done: told.append((time.monotonic(), done))
        )
        ended = time.monotonic()
    moved_s = (told[-1][0] if told else ended) - began
    moments = [began, *(moment for moment, _ in told)]
    batches = [1e6 * (b - a) for a, b in itertools.pairwise(moments)]
    return {
        "s": ended - began,
        "moving_s": moved_s,
        "rows": report.moved_rows,
        "bytes": report.moved_bytes,
        "rows_before": report.rows_before,
        "rows_after": report.rows_after,
        "batches_us": summary(batches),
        "beside": {
            name: {
                "before_us": summary([us for at, us in seen if at < began]),
                "meanwhile_us": summary([us for at, us in seen if began <= at < ended]),
            }
            for name, seen in times.items()
        },
    }


def main() -> None:
    """Import, rebalance, print, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--bits", type=int, default=11)
    parser.add_argument("--shards", type=int, default=4)
    parser.add_argument("--out", type=Path, help="file of figures, JSON")
    given = parser.parse_args()
    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)  # after the servers have ended
    with awake():
        url = f"postgresql:///bench?data={folder}/servers&shards={given.shards}"
        started = time.perf_counter()
        options = ImportOptions(grid=GridOptions(bits=given.bits))
        hapticdb.import_files(url, given.files, options)
        imported_s = time.perf_counter() - started
        with contextlib.closing(open_store(url, read_only=True)) as store:
            size = store.size()
        found: dict[str, Any] = {
            "commit": records.commit(),
            "load_before": os.getloadavg()[0],
            "conditions": {"bits": given.bits, "shards": given.shards, "rows": size.rows,
                           "band_rows": size.band_rows},
            "import_s": imported_s,
        }  # fmt: skip
        found["rebalance"] = rebalanced(url)
    text = json.dumps(found, indent=1) + "\n"
    print(text)
    if given.out:
        given.out.write_text(text)


if __name__ == "__main__":
    main()
