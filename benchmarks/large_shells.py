"""Large tools: sleeping clusters beside the flat loop, at 10^5 and 10^6 points.

    make paths
    python benchmarks/large_shells.py --quick

A sheet of points slides over a box as a hand moves it, at 0.5 m/s and 1 kHz, up and down and with
small turns. The box lies below a given share of the sheet. The flat loop and sleeping clusters take
turns on the same poses, and give the same wrenches bit for bit. Sleeping clusters with a budget of
points take their turns, too, where more points are near; their wrenches differ, and it is said by
how much. Cells are resident; one processor computes.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hapticdb
import page_tables
import records
from awake import awake
from hapticdb import DistanceField, GridOptions, ImportOptions, PointShell, TangentPlane
from hapticdb.kernels.large.budget import feel_kernel
from hapticdb.kernels.large.sleeping import LEFT_OUT, LOOKED_AT
from hapticdb.kernels.resident.cells import RESULTS
from hapticdb.query.law import ForceLaw
from hapticdb.resident.frames import FeltFrames, ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable

Floats = NDArray[np.float64]
LAWS: dict[str, ForceLaw] = {"plane": TangentPlane(), "smooth": DistanceField()}
SIZES = (100_000, 1_000_000)
"""Points of the sheet."""
SHARES = (0.05, 0.25)
"""Of the sheet that the box is below."""
BITS = 11
"""Of the grid on each axis."""
EDGE = 1.0
"""Edge of the sheet, metres."""
SPEED, RATE = 0.5, 1000.0
"""Of the hand: metres a second, and frames a second."""
ROUNDS = 5
"""Timed passes over all poses; a frame's time is the least of them, without what others cost."""
BUDGET = 10_000
"""Points near something that a frame with a budget looks at, at most."""
TABLE = 512 << 20
"""Bytes for cells."""


def sheet(n_points: int, edge: float = EDGE) -> PointShell:
    """A square sheet of points in Z-order, whose normals point up into the tool."""
    side = round(n_points**0.5)
    ij = np.argwhere(np.ones((side, side), dtype=bool))
    codes = sum(((ij[:, a] >> b) & 1) << (2 * b + a) for a in range(2) for b in range(12))
    ij = ij[np.argsort(codes)]
    points = np.column_stack([(ij + 0.5) / side * edge, np.zeros(len(ij))])
    return PointShell(points, np.tile((0.0, 0.0, 1.0), (len(ij), 1)), np.array([edge / 2] * 3))


def slide(count: int, voxel_size: float) -> Floats:
    """Poses (count, 4, 4) of a hand at `SPEED` along the box, up and down, with small turns."""
    seconds = np.arange(count) / RATE
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = SPEED * seconds
    poses[:, 2, 3] = voxel_size * (1.0 + 2.0 * np.sin(2.0 * np.pi * seconds * 4.0))
    angle = 1e-3 * np.sin(2.0 * np.pi * seconds * 3.0)
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angle)
    poses[:, 0, 1], poses[:, 1, 0] = -np.sin(angle), np.sin(angle)
    return poses


def write_box(path: Path, share: float, length: float, edge: float = EDGE) -> None:
    """An STL file of a box below a share of the sheet, `length` along the way of the hand."""
    low, high = np.array([0.0, -0.1 * edge, -0.02]), np.array([share * edge, length, 0.0])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    corners = low + corners * (high - low)
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    lines = ["solid box"]
    for a, b, c, d in quads:
        for three in ((a, b, c), (a, c, d)):
            lines += ["facet normal 0 0 0", "outer loop"]
            lines += ["vertex {} {} {}".format(*corners[n]) for n in three]
            lines += ["endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid box", ""]))


def frame_times(frame: Callable[[Floats], object], poses: Floats) -> Floats:
    """Seconds of each frame (M,)."""
    spent = np.empty(len(poses))
    for n in range(len(poses)):
        started = time.perf_counter()
        frame(poses[n : n + 1])
        spent[n] = time.perf_counter() - started
    return spent


def measure(
    database: Path, law: str, shell: PointShell, poses: Floats, rounds: int = ROUNDS
) -> dict[str, Any]:
    """Times of a frame, us, by ways that take turns; without a budget they agree bit for bit."""
    distances = law == "smooth"
    with (
        hapticdb.open(database, read_only=True) as env,
        CellTable.create(TABLE, distances=distances) as table,
    ):
        residency = Residency(env.store, table)
        ways = {
            "flat": ResidentFrames(residency, shell, LAWS[law], run=0),
            "sleeping": ResidentFrames(residency, shell, LAWS[law], sleeps=True),
            "budget": ResidentFrames(residency, shell, LAWS[law], budget_points=BUDGET),
        }
        felt = {name: one.feel(poses) for name, one in ways.items()}
        if not felt["budget"].left_out.any():
            del ways["budget"]
        wrenches = {(felt[name].wrenches + 0.0).tobytes() for name in ways if name != "budget"}
        if len(wrenches) != 1:
            raise SystemExit("the wrenches differ")
        out = np.zeros((1, RESULTS))
        looked: list[int] = []
        with table.reading() as row, awake():

            def frame_of(one: ResidentFrames) -> Callable[[Floats], object]:
                counts, sleeps = one.asleep.counts, len(one.asleep.sleepers.boxes) > 0

                def frame(pose: Floats) -> None:
                    counts[:] = 0
                    feel_kernel(
                        one.cells, row, one.clusters, pose, residency.place, one.law, one.hits,
                        one.missed, out, one.asleep,
                    )  # fmt: skip
                    if sleeps:
                        looked.append(int(counts[0, LOOKED_AT]) + int(counts[0, LEFT_OUT]))

                return frame

            frames = {name: frame_of(one) for name, one in ways.items()}
            least: dict[str, Floats] = {}
            for _ in range(rounds):
                for name, frame in frames.items():
                    spent = frame_times(frame, poses)
                    least[name] = np.minimum(least.get(name, np.inf), spent)
        shares = np.array(looked) / len(shell)
        us = {
            name: {f"p{p}": float(np.percentile(spent * 1e6, p)) for p in (50, 99, 100)}
            for name, spent in least.items()
        }
        return {
            "budget": _within_budget(felt["flat"], felt["budget"]),
            "points": len(shell),
            "law": law,
            "near_share": float(shares.mean()),
            "contacts": float(felt["flat"].contacts.mean()),
            "us": us,
            "ratio": {name: us[name]["p50"] / us["flat"]["p50"] for name in us},
            "bytes_a_point": bytes_of(ways["sleeping"]) / len(shell),
        }


def _within_budget(whole: FeltFrames, part: FeltFrames) -> dict[str, Any]:
    """What a budget leaves out, and how far its forces are from those of all points."""
    forces = np.linalg.norm(whole.wrenches[:, :3], axis=1)
    off = np.linalg.norm(part.wrenches[:, :3] - whole.wrenches[:, :3], axis=1)
    return {
        "points": BUDGET,
        "left_out_frames": int((part.left_out > 0).sum()),
        "looked_at": float(part.looked_at.mean()),
        "most_off": float(off.max() / forces.max()) if forces.any() else 0.0,
    }


def bytes_of(frames: ResidentFrames) -> int:
    """Memory of a shell's arrays, bytes."""
    arrays = [*frames.clusters, *frames.asleep.sleepers, frames.hits]
    return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))


def compare(
    folder: Path, sizes: Sequence[int], shares: Sequence[float], count: int, bits: int
) -> list[dict[str, Any]]:
    """Every size, share and law."""
    voxel_size = 2.0 * EDGE / (1 << bits)
    poses = slide(count, voxel_size)
    lines = []
    for share in shares:
        part, database = folder / f"box-{share}.stl", folder / f"box-{share}.db"
        write_box(part, share, 1.5 * EDGE)
        options = GridOptions(bits=bits, voxel_size=voxel_size, origin=(-0.5, -0.25, -1.0))
        hapticdb.import_files(database, [part], ImportOptions(grid=options))
        for size in sizes:
            for law in LAWS:
                line = {"wanted_share": share} | measure(database, law, sheet(size), poses)
                print(json.dumps(line), flush=True)
                lines.append(line)
    return lines


def main() -> None:
    """Measure, and fill the table of docs/realtime.md."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="few frames, into results-quick/")
    given = parser.parse_args()
    out = Path("results-quick" if given.quick else "results")
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    sizes, count = (SIZES[:1], 50) if given.quick else (SIZES, 500)
    with tempfile.TemporaryDirectory(prefix="hapticdb-large-") as folder:
        lines = compare(Path(folder), sizes, SHARES, count, BITS)
    records.write(out, {"large_shells": records.conditions() | {"lines": lines}})
    if not given.quick:
        page_tables.refill("docs/realtime.md", out)


if __name__ == "__main__":
    main()
