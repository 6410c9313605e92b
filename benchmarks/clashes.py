"""Every pair of an assembly: processor time and memory of a full search, and of one changed part.

    make clashes                             # the VW T1 three times: 4,284 parts
    python benchmarks/clashes.py --copies 1

Each search runs in a process of its own, with every kernel compiled. The distances alone are those
of the same pairs, without their kinds.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.spatial  # noqa: F401 - a quarter of a second that is no part of a search

import hapticdb
import records
from hapticdb.clashes import run
from hapticdb.clashes.near import near_pairs
from hapticdb.clashes.shapes import Shapes
from hapticdb.ingest.geometry import parts_of
from hapticdb.kernels.triangles.nearest import nearest
from hapticdb.store.base import NO_ROWS

FILE = "assembly_vw_t1/vw_t1.glb"
APART = 0.3
"""Metres between copies."""
LONGEST_S = 3600.0
"""Seconds after which a search counts as hung."""


def make(url: Path, copies: int) -> None:
    """Copies of the assembly beside one another, without rows: surfaces alone count."""
    file = Path(os.environ["HAPTICDB_TEST_DATA"], FILE)
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=8, extent=3.0), distances=False)
    hapticdb.import_files(url, [file], options)
    with hapticdb.open(url) as env:
        first = env.objects()
        for n in range(1, copies):
            for obj in first:
                shift = np.array([0.0, n * APART, 0.0])
                moved = obj.transform.copy()
                moved[:3, 3] += shift
                copy = replace(
                    obj, id=0, link=f"{obj.link} {n}", transform=moved, bounds=obj.bounds + shift
                )
                env.store.add(copy, NO_ROWS)


def measured(what: str, url: str) -> dict[str, Any]:
    """One search, in this process: processor time without imports, and the peak of memory."""
    with hapticdb.open(url) as env:
        if what == "one changed":
            env.shift([env.objects()[100].id], (0.0, 0.0, 1e-4))
        hapticdb.find_clashes(env, of=[1], seconds=1e-9)  # loads kernels, measures nothing
        began, wall = time.process_time(), time.perf_counter()
        found: dict[str, Any]
        if what == "distances alone":
            found = {"pairs": distances(env)}
        else:
            clashes = hapticdb.find_clashes(env)
            found = {"pairs": clashes.measured, "told": clashes.counts()}
        found["cpu_s"] = time.process_time() - began
        found["s"] = time.perf_counter() - wall
    found["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {"search": what} | found


def distances(env: hapticdb.Environment) -> int:
    """Measure the distance of every pair of near boxes."""
    objects = env.objects()
    everything = np.ones(len(objects), dtype=np.bool_)
    pairs = near_pairs(objects, run.WITHIN, everything, everything)
    shapes = Shapes(env.store, run.BUDGET)
    for i, j in pairs.tolist():
        one, other = shapes.placed(objects[i]), shapes.placed(objects[j])
        assert one is not None
        assert other is not None
        pose = np.linalg.inv(one[1]) @ other[1]
        nearest(one[0].tree, other[0].tree, pose[None], np.full(1, run.WITHIN))
    return len(pairs)


def main() -> None:
    """Measure each search in a process of its own, print, and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--copies", type=int, default=3)
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.measure:
        print(json.dumps(measured(*asked.measure)))
        return
    hapticdb.warm_up()
    with tempfile.TemporaryDirectory() as folder:
        url = Path(folder, "scene.db")
        make(url, asked.copies)
        with hapticdb.open(url, read_only=True) as env:
            parts = [part for _, part in parts_of(env.store, env.objects())]
        triangles = sum(0 if part.faces is None else len(part.faces) for part in parts)
        inputs = {"model": FILE, "parts": len(parts), "triangles": triangles}
        cells = []
        for what in ("distances alone", "everything", "one changed", "nothing changed"):
            again = [sys.executable, __file__, "--measure", what, str(url)]
            done = subprocess.run(again, check=True, capture_output=True, timeout=LONGEST_S)
            cells.append(json.loads(done.stdout))
            print(cells[-1], flush=True)
    records.write(Path("results"), {"clashes": records.result("clashes", cells, inputs)})


if __name__ == "__main__":
    main()
