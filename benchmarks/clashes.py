"""Every pair of an assembly: processor time and memory of a full search, and of one changed part.

    make clashes    # the VW T1 three times: 4,284 parts; two cars, one VW T1, LeKiwi

The car is the sample as it was before its parts were made to keep apart: 294 of its 1,163 pairs of
near boxes overlap, most of them deeply. Each search runs in a process of its own, kernels loaded.
"""

import argparse
import json
import lzma
import os
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
from costs import PEAK
from hapticdb.ingest.geometry import parts_of
from hapticdb.kernels._jit import load_entries
from hapticdb.store.base import NO_ROWS
from page_tables import publish

FILE, ROBOT = "assembly_vw_t1/vw_t1.glb", "robot_lekiwi/lekiwi.glb"
VINTAGE = "demo_vintage_car/vintage_car.glb"
CAR = Path(__file__).with_name("unmended_car.xz")
"""A GLB file whose arrays are differences of integers: lengths in 0.01 mm, and indices."""
APART = 0.3
"""Metres between copies."""
SEARCHES = "everything", "one changed", "nothing changed"
LONGEST_S = 3600.0
"""Seconds after which a search counts as hung."""


def unmended_car(folder: Path) -> Path:
    """Write the car as a GLB file."""
    packed = lzma.decompress(CAR.read_bytes())
    end = 20 + int.from_bytes(packed[12:16], "little")
    glb, begin = bytearray(packed[: end + 8]), end + 8
    for array in json.loads(packed[20:end])["accessors"]:
        axes = 3 if array["type"] == "VEC3" else 1
        steps = np.frombuffer(packed, "<i4", axes * array["count"], begin).reshape(axes, -1)
        begin += steps.nbytes
        values = np.cumsum(steps, axis=1, dtype=np.int64).T
        glb += (
            (values / 1e5).astype("<f4").tobytes() if axes == 3 else values.astype("<u4").tobytes()
        )
    file = folder / "unmended_car.glb"
    file.write_bytes(glb)
    return file


def make(url: Path, file: Path, extent: float, copies: int = 1) -> dict[str, Any]:
    """Copies of an assembly beside one another, without rows: surfaces alone count.

    Returns what is known of them.
    """
    grid = hapticdb.GridOptions(bits=8, extent=extent)
    hapticdb.import_files(url, [file], hapticdb.ImportOptions(grid=grid, distances=False))
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
        parts = [part for _, part in parts_of(env.store, env.objects())]
    triangles = sum(0 if part.faces is None else len(part.faces) for part in parts)
    return {"model": file.name, "parts": len(parts), "triangles": triangles}


def measured(what: str, url: str) -> dict[str, Any]:
    """One search, in this process: processor time without imports, and the peak of memory.

    list_cpu_s : of making the list of all pairs, which a search leaves to who asks for it.
    """
    load_entries()
    with hapticdb.open(url) as env:
        if what == "one changed":
            env.shift([env.objects()[100].id], (0.0, 0.0, 1e-4))
        hapticdb.find_clashes(env, of=[1], seconds=1e-9)  # measures nothing
        began, wall = time.process_time(), time.perf_counter()
        found = hapticdb.find_clashes(env)
        counts = found.counts()
        ended, over = time.process_time(), time.perf_counter()
        n_listed = len(found.pairs)
        listed = time.process_time()
    return {
        "search": what,
        "pairs": found.measured,
        "counts": counts,
        "listed": n_listed,
        "cpu_s": ended - began,
        "s": over - wall,
        "list_cpu_s": listed - ended,
        "peak_mb": int(PEAK.findall(Path("/proc/self/status").read_text())[0]) * 1.024e-3,
    }


def main() -> None:
    """Measure each search in a process of its own, print, and write the results."""
    parser = argparse.ArgumentParser(description=records.first_line(__doc__))
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.measure:
        print(json.dumps(measured(*asked.measure)))
        return
    data = Path(os.environ["HAPTICDB_TEST_DATA"])
    with tempfile.TemporaryDirectory() as name:
        folder, cells, inputs = Path(name), [], []
        for scene, file, extent, copies, searches in (
            ("three vans", data / FILE, 3.0, 3, SEARCHES),
            ("unmended car", unmended_car(folder), 8.0, 1, SEARCHES[:1]),
            ("vintage car", data / VINTAGE, 3.0, 1, SEARCHES[:1]),
            ("van", data / FILE, 3.0, 1, SEARCHES[:1]),
            ("LeKiwi", data / ROBOT, 3.0, 1, SEARCHES[:1]),
        ):
            url = folder / f"{scene}.db"
            inputs.append({"scene": scene, **make(url, file, extent, copies)})
            for what in searches:
                again = [sys.executable, __file__, "--measure", what, str(url)]
                done = subprocess.run(again, check=True, capture_output=True, timeout=LONGEST_S)
                cells.append({"scene": scene, **json.loads(done.stdout)})
                print(cells[-1], flush=True)
    publish("clashes", cells, {"scenes": inputs})


if __name__ == "__main__":
    main()
