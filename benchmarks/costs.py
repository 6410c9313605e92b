"""What an environment costs: time and memory of an import, bytes of a voxel, and the first start.

Each import runs in a process of its own, with every kernel compiled.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import hapticdb
from hapticdb import GridOptions, ImportOptions
from hapticdb.kernels._machine_code import GROUPS
from hapticdb.kernels._sets import fitting_set
from hapticdb.mesh import read_file
from hapticdb.sample import SampleFiles

PEAK = re.compile(r"VmHWM:\s+(\d+) kB")
LONGEST_S = 1800.0
"""Seconds after which a command counts as hung."""
PACKAGE = Path(hapticdb.__file__).parent
FIRST = {
    "import": ("import", "{turn}.db", "{car}", "--bits", "8", "--extent", "1.6"),
    "touch": ("touch", "{turn}.db", "--tool", "{tool}", "--poses", "{path}"),
    "sweep": ("sweep", "{turn}.db", "--tool", "{tool}", "--path", "{path}"),
    "feel": ("feel", "{turn}.db", "--tool", "{tool}", "--device", "{path}", "--seconds", "0.2"),
}
"""Commands of a first start."""


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
        "peak_mb": int(PEAK.findall(Path("/proc/self/status").read_text())[0]) / 1e3,
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


def first_start(folder: Path, sample: SampleFiles) -> list[dict[str, Any]]:
    """Seconds of first commands of a new copy as a wheel has it, and of the same commands again."""
    places = {"car": sample.car, "tool": sample.spanner, "path": sample.path}
    shutil.copytree(
        PACKAGE, folder / "hapticdb", ignore=shutil.ignore_patterns("__pycache__", "_machine")
    )
    for group in GROUPS:
        fitting = fitting_set(group)
        assert fitting is not None
        shutil.copytree(fitting[0], folder / "hapticdb/kernels/_machine" / group)
    variables = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": str(folder)}
    cells = []
    for name, words in FIRST.items():
        cell: dict[str, Any] = {"command": name}
        for turn in ("first", "again"):
            line = [word.format(turn=turn, **places) for word in words]
            began = time.perf_counter()
            subprocess.run(
                [sys.executable, "-m", "hapticdb", *line],
                cwd=folder, env=variables, check=name != "sweep", capture_output=True,
                timeout=LONGEST_S,
            )  # fmt: skip
            cell[f"{turn}_s"] = time.perf_counter() - began
        cells.append(cell)
    return cells


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    for word, kind in {"url": str, "file": str, "bits": int, "extent": float, "d": int}.items():
        parser.add_argument(word, type=kind)
    print(json.dumps(imported(*vars(parser.parse_args()).values())))
