"""What an environment costs: time and memory of an import, and bytes of a voxel.

Each import runs in a process of its own, with every kernel compiled.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import hapticdb
from hapticdb import GridOptions, ImportOptions
from hapticdb.mesh import read_file

PEAK = re.compile(r"VmHWM:\s+(\d+) kB")
LONGEST_S = 1800.0
"""Seconds after which a command counts as hung."""


class Model(NamedTuple):
    """A model: name, file, edge of the grid as a multiple of the model's longest side."""

    name: str
    file: Path
    extent: float


def models(sample: Path, *, real: bool) -> list[Model]:
    """Real assemblies in the folder that HAPTICDB_TEST_DATA names, then the sample car."""
    data = Path(os.environ.get("HAPTICDB_TEST_DATA", ""))
    found = [
        Model("vintage car", data / "demo_vintage_car" / "vintage_car.glb", 1.6),
        Model("van", data / "assembly_vw_t1" / "vw_t1.glb", 2.4),
        Model("robot", data / "robot_lekiwi" / "lekiwi.glb", 1.2),
    ]
    return [one for one in found if real and one.file.is_file()] + [
        Model("sample car", sample, 1.6)
    ]


def imported(url: str, file: str, bits: int, extent: float, distances: int) -> dict[str, Any]:
    """Import in this process: wall and processor time, and the peak of memory."""
    options = ImportOptions(grid=GridOptions(bits=bits, extent=extent), distances=bool(distances))
    began, busy = time.perf_counter(), time.process_time()
    (report,) = hapticdb.import_files(url, [file], options)
    if report.error is not None:
        raise report.error
    return {
        "s": time.perf_counter() - began,
        "cpu_s": time.process_time() - busy,
        "peak_mb": int(PEAK.findall(Path("/proc/self/status").read_text())[0]) * 1.024e-3,
    }


def measured(folder: Path, model: Model, bits: int) -> dict[str, Any]:
    """Import a model with and without distances; what it holds, and what it takes on disk."""
    cell: dict[str, Any] = {"environment": model.name, "bits": bits, "extent": model.extent}
    parts = read_file(model.file).parts
    cell["triangles"] = sum(len(part.triangles()) for part in parts)
    for name, distances in (("plain", 0), ("distance", 1)):
        url = folder / f"cost-{name}.db"
        words = [str(url), str(model.file), str(bits), str(model.extent), str(distances)]
        done = subprocess.run(
            [sys.executable, __file__, *words], check=True, capture_output=True, timeout=LONGEST_S
        )
        cell[name] = json.loads(done.stdout)
        with hapticdb.open(url, read_only=True) as env:
            size, objects = env.size(), env.objects()
            cell[name] |= {"bytes": size.bytes, "rows": size.rows}
            cell |= {"objects": len(objects), "object_voxels": sum(obj.voxels for obj in objects)}
        url.unlink()
    return cell


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    for word, kind in {"url": str, "file": str, "bits": int, "extent": float, "d": int}.items():
        parser.add_argument(word, type=kind)
    print(json.dumps(imported(*vars(parser.parse_args()).values())))
