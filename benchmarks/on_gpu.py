"""Frames and batches on a graphics processor, beside the processors of the same machine.

    python benchmarks/on_gpu.py --prepare FOLDER    # anywhere: a scene, a tool and poses
    python benchmarks/on_gpu.py --scene FOLDER      # where a GPU is: results/gpu.json

It tells how far both are apart, and whether each answer repeats bit for bit. It times frames, pose
in and wrench out, of 300 to 10^7 points, and poses a second of 300 points that are far from
everything, within a few voxels, or touching; all cells are resident. Last come sessions of `feel`:
a hand that comes to what it touches, its looks on either side.
"""

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray

import hapticdb
import records
from batches import EXTENT, MODEL, poses_by_situation
from hapticdb import Environment, GridOptions, ImportOptions, PointShell, Session
from hapticdb.batches.batch_tool import BatchTool
from hapticdb.batches.on_gpu import GpuFrames
from hapticdb.devices.scripted import Player
from hapticdb.ingest.geometry import parts_of
from hapticdb.kernels.records.hand import RESULT
from hapticdb.poses import read_poses
from hapticdb.sample import write_sample
from slide_paths import write_along

Floats = NDArray[np.float64]
BITS = 10
"""Of the grid on each axis."""
BASE = 100_000
"""Points of the shell that larger ones are made of, by points around its own."""
SIZES = (300, BASE, 1_000_000, 10_000_000)
FEW = 300
MOST_POSES = 20_000
"""Poses of each situation; batches repeat them."""
BATCH = 1_000_000
"""Poses of a batch on the GPU; the processors get `MOST_POSES`."""
TABLE = 2 << 30
"""Bytes for cells."""
PACKAGES = ("numpy", "numba", "numba-cuda")
REPEATS = 1000
"""Frames whose times are sorted."""
TIMEOUT = 5.0
"""Seconds of the frames of one shell on one side, at most about."""


def prepare(folder: Path, bits: int, most: int) -> None:
    """Write scene.db, the tool's shells, and poses of each situation."""
    real = Path(os.environ.get("HAPTICDB_TEST_DATA", ""), MODEL)
    sample = write_sample(folder)
    car = real if real.is_file() else sample.car
    url = folder / "scene.db"
    hapticdb.import_files(
        str(url), [car], ImportOptions(grid=GridOptions(bits=bits, extent=EXTENT))
    )
    tool, path = sample.spanner, sample.path
    if real.is_file():
        tool, path = write_along(folder / "along", url, 400)
    few, many = (PointShell.from_file(tool, points=n) for n in (FEW, BASE))
    few.save(folder / "few.npz")
    many.save(folder / "many.npz")
    with hapticdb.open(url, read_only=True) as env:
        found = poses_by_situation(env, few, read_poses(path), most)
    np.savez_compressed(folder / "poses.npz", **found)  # type: ignore[arg-type]


def larger(shell: PointShell, n_points: int, spread: float) -> PointShell:
    """A shell of so many points: those of a shell, each with others around it."""
    if n_points <= len(shell):
        return shell
    times = n_points // len(shell)
    around = np.random.default_rng(3).normal(size=(n_points, 3)) * spread
    points = np.repeat(shell.points, times, axis=0) + around
    return PointShell(points, np.repeat(shell.normals, times, axis=0), shell.center)


def percentiles(seconds: list[float]) -> dict[str, float]:
    """Milliseconds: p50, p99, worst."""
    p50, p99 = 1e3 * np.percentile(seconds, [50, 99])
    return {"p50_ms": p50, "p99_ms": p99, "worst_ms": 1e3 * max(seconds), "frames": len(seconds)}


def results_of(gpu: GpuFrames, poses: Floats) -> Floats:
    """Results (B, 10) of frames on the GPU, in the order of the processor's."""
    return np.concatenate([
        np.hstack([found.forces, found.torques, np.stack(found[2:], axis=1)])
        for _, found in gpu.run(poses)
    ])  # fmt: skip


def on_processor(batch_tool: BatchTool, poses: Floats) -> Floats:
    """The same of frames on the processor, in one thread."""
    frames, out = batch_tool._frames, np.zeros(len(poses), RESULT)  # noqa: SLF001 - measured
    frames._run(poses, out, 0, len(poses))  # noqa: SLF001
    return out.view(np.float64).reshape(len(poses), -1)


def compared(batch_tool: BatchTool, gpu: GpuFrames, poses: Floats) -> dict[str, Any]:
    """How far both are apart at poses, relative to the largest, and whether the GPU repeats."""
    ours, theirs = results_of(gpu, poses), on_processor(batch_tool, poses)
    again = np.concatenate([results_of(gpu, poses[n : n + 1]) for n in range(min(len(poses), 64))])

    def apart(part: slice) -> float:
        largest = np.abs(theirs[:, part]).max(initial=0.0)
        return float(np.abs(ours[:, part] - theirs[:, part]).max(initial=0.0) / (largest or 1.0))

    return {
        "poses": len(poses),
        "force": apart(slice(0, 3)),
        "torque": apart(slice(3, 6)),
        "deepest": apart(slice(9, 10)),
        "counts_equal": float((ours[:, 6:9] == theirs[:, 6:9]).all(axis=1).mean()),
        "repeats": bool((again == ours[: len(again)]).all()),
        "unknown": int(ours[:, 8].sum()),
    }


def seconds_of(feel: Callable[[Floats], object], poses: Floats, repeats: int) -> list[float]:
    """Seconds of one frame after another, for `TIMEOUT` at most about."""
    times: list[float] = []
    while sum(times) < TIMEOUT and len(times) < repeats:
        one = poses[len(times) % len(poses)]
        began = time.perf_counter()
        feel(one)
        times.append(time.perf_counter() - began)
    return times


def frames_of(batch_tool: BatchTool, poses: Floats, repeats: int) -> dict[str, Any]:
    """Check frames of one shell, and time them one by one on both."""
    gpu = batch_tool._gpu  # noqa: SLF001 - measured
    assert gpu is not None
    n_points = len(batch_tool.shell)
    batch_tool.touch(poses)  # fetches the cells
    some = poses[: max(2, min(len(poses), 10_000_000 // n_points))]
    equality = compared(batch_tool, gpu, some)
    times = seconds_of(gpu.evaluate, poses, repeats)
    cpu = seconds_of(lambda one: on_processor(batch_tool, one[None]), poses, repeats)
    found = {"points": n_points, "equal": equality, "gpu": percentiles(times)}
    return found | {"one_processor": percentiles(cpu)}


def hands_of(folder: Path, shell: PointShell, ends: Floats, *, quick: bool) -> Any:  # noqa: ANN401
    """Periods of a hand that goes from one pose to another, looks on the GPU and on a processor."""
    seconds, rate = (1.0, 10.0) if quick else (3.0, 1000.0)
    found: dict[str, Any] = {"points": len(shell)}
    for name, frames_on in (("gpu", "cuda"), ("processor", "cpu")):
        with Session(
            str(folder / "scene.db"), shell, Player([0.0, 0.5 * seconds], ends), rate=rate,
            seconds=seconds, frames_on=frames_on, has_baseline=False,  # type: ignore[arg-type]
        ) as session:  # fmt: skip
            report = session.wait(60.0 + 20.0 * seconds)
        assert report is not None
        spread = report.loop.elapsed._asdict()
        found[name] = {f"{key}_ms": 1e3 * value for key, value in spread.items()}
        found[name] |= {"reached_hz": report.loop.rate, "contact_frames": report.contact_frames}
    return found


def batches_of(
    on_gpu: BatchTool, on_cpu: BatchTool, poses: Floats, size: int, situation: str
) -> dict[str, Any]:
    """Poses a second, as a caller gets them, and of the launches alone."""
    gpu = on_gpu._gpu  # noqa: SLF001 - measured
    assert gpu is not None
    many = np.resize(poses, (size, 4, 4))
    on_gpu.touch(poses)
    on_cpu.touch(poses)
    equality = compared(on_gpu, gpu, poses[:2000])
    found = {"situation": situation, "poses": size, "equal": equality}
    rates: dict[str, list[float]] = {"touch": [], "launches": [], "processors": []}
    for _ in range(3):
        began = time.perf_counter()
        felt = on_gpu.touch(many)
        rates["touch"].append(size / (time.perf_counter() - began))
        began = time.perf_counter()
        for _part, _found in gpu.run(many):
            pass
        rates["launches"].append(size / (time.perf_counter() - began))
        began = time.perf_counter()
        on_cpu.touch(poses)
        rates["processors"].append(len(poses) / (time.perf_counter() - began))
    found["touching"] = float((felt.n_contacts > 0).mean())
    return found | {f"{name}_poses_per_s": float(np.median(all_)) for name, all_ in rates.items()}


def clearance_of(on_gpu: BatchTool, on_cpu: BatchTool, poses: Floats) -> dict[str, Any]:
    """Poses a second whose distance is told, and how far both answers are apart."""
    rates: dict[str, float] = {}
    found = []
    for name, batch_tool in (("gpu", on_gpu), ("processors", on_cpu)):
        batch_tool.clearance(poses)  # fetches the cells
        began = time.perf_counter()
        found.append(batch_tool.clearance(poses).distances)
        rates[f"clearance_{name}_poses_per_s"] = len(poses) / (time.perf_counter() - began)
    apart = float(np.abs(found[0] - found[1]).max() / on_cpu._residency.grid.voxel_size)  # noqa: SLF001
    return rates | {"clearance_apart_voxels": apart}


def by_triangles(
    env: Environment, shell: PointShell, situations: dict[str, Floats], batch: int
) -> dict[str, Any]:
    """Poses a second of Warp's mesh queries: the nearest triangle within what the law feels."""
    try:
        from warp_peer import WarpMesh  # noqa: PLC0415 - may not be installed
    except ImportError as error:
        return {"note": f"Warp was not measured: {error}"}
    parts = parts_of(env.store, env.objects())
    triangles = np.concatenate([part.surface() for _, part in parts])
    mesh = WarpMesh(triangles, shell.points)
    found: dict[str, Any] = {"triangles": len(triangles)}
    for reach in (2.5, 32.0):
        for situation, poses in situations.items():
            many = np.resize(poses, (1, batch, 4, 4))
            ask = partial(mesh.distances, reach=reach * env.grid.voxel_size)
            rate = batch / float(np.median(seconds_of(ask, many, 3)))
            found[f"{situation}_within_{reach:g}_voxels_poses_per_s"] = rate
    return found


def measure(
    folder: Path, sizes: tuple[int, ...], batch: int, repeats: int, *, quick: bool = False
) -> dict[str, Any]:
    """Measure all; results as records for JSON."""
    few, many = PointShell.load(folder / "few.npz"), PointShell.load(folder / "many.npz")
    situations = dict(np.load(folder / "poses.npz"))
    frames, batches, hands = [], [], []
    name = getattr(cuda.current_context().device, "name", "none: simulated")
    with hapticdb.open(folder / "scene.db", read_only=True) as env:
        with (
            env.batch_tool(few, budget_bytes=TABLE, device="cuda") as on_gpu,
            env.batch_tool(few, budget_bytes=TABLE) as on_cpu,
        ):
            for situation, poses in situations.items():
                found = batches_of(on_gpu, on_cpu, poses, batch, situation)
                batches.append(found | clearance_of(on_gpu, on_cpu, poses))
                print(batches[-1], flush=True)
        triangles = by_triangles(env, few, situations, min(batch, 200_000))
        voxel = env.grid.voxel_size
        for n_points in sizes:
            shell = few if n_points == len(few) else larger(many, n_points, 0.3 * voxel)
            with env.batch_tool(shell, budget_bytes=TABLE, device="cuda") as batch_tool:
                touching = np.ascontiguousarray(situations["touching"][:64])
                frames.append(frames_of(batch_tool, touching, repeats))
            ends = np.stack([situations["free"][0], touching[0]])
            hands.append(hands_of(folder, shell, ends, quick=quick))
            print(frames[-1], hands[-1], flush=True)
    about = {
        "card": name.decode() if isinstance(name, bytes) else str(name),
        "machine": records.machine(),
        "versions": {one.name: one.version for one in distributions() if one.name in PACKAGES},
        "memory_for_cells": TABLE,
    }
    return about | {"frames": frames, "hands": hands, "batches": batches, "warp": triangles}


def main() -> None:
    """Prepare, or measure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--prepare", type=Path, help="write scene, tool and poses to a folder")
    parser.add_argument("--scene", type=Path, help="measure with what was prepared")
    parser.add_argument("--out", type=Path, default=Path("results"))
    parser.add_argument("--quick", action="store_true", help="a small scene, few frames")
    given = parser.parse_args()
    if given.prepare is not None:
        given.prepare.mkdir(parents=True, exist_ok=True)
        prepare(given.prepare, 7 if given.quick else BITS, 50 if given.quick else MOST_POSES)
    if given.scene is not None:
        sizes, batch = (SIZES[:1], 20) if given.quick else (SIZES, BATCH)
        repeats = 3 if given.quick else REPEATS
        found = measure(given.scene, sizes, batch, repeats, quick=given.quick)
        records.write(given.out, {"gpu": found})


if __name__ == "__main__":
    main()
