"""The demo: the sample in both layouts, under every strategy, timed and compared.

Hits, ids and wrench of every pose are compared bit for bit over strategies and layouts, under the
tangent-plane law, the one common to all. Times are warm: each strategy has run before, and the
strategies take turns at going first.
"""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import GridError, UsageError
from hapticdb.grid import GridOptions
from hapticdb.ingest.files import ImportCallback, ImportOptions, import_files
from hapticdb.paper.strategies import Strategy
from hapticdb.pointshell.shell import PointShell
from hapticdb.poses import read_poses
from hapticdb.query.touches import Query, Touch
from hapticdb.sample import SampleFiles, write_sample
from hapticdb.store.base import Layout

COMPARED: tuple[Strategy, ...] = ("statement", "points", "array", "maxgap", "cbgroup", "auto")
YARDSTICK: Strategy = "points"
"""The paper's point query sequence, the reference of the comparison."""
WARM_POSES = 20
"""Untimed poses of each strategy. More take longer and change little."""


class Imported(NamedTuple):
    """One environment of the demo."""

    layout: Layout
    url: str
    engine: str
    seconds: float  # of the import
    objects: int
    voxels: int
    rows: int
    bytes: int
    is_new: bool  # whether the import added anything


@dataclass(frozen=True)
class DemoScene:
    """Files and environments of the demo."""

    folder: Path
    files: SampleFiles
    imported: tuple[Imported, ...]
    shell: PointShell
    poses: NDArray[np.float64]
    grid_text: str


@dataclass(frozen=True)
class LayoutFigures:
    """Query figures of all strategies on one layout, pose by pose."""

    imported: Imported
    felt: dict[Strategy, list[Query]]

    def median_us(self, strategy: Strategy) -> float:
        """Median time of a strategy's frames, microseconds."""
        return float(np.median([query.elapsed_us for query in self.felt[strategy]]))


@dataclass
class Trace:
    """Contacts along the path, for the picture; the same for every strategy."""

    force: NDArray[np.float64]  # (M,) newtons
    hits: NDArray[np.int64]  # (M,) number at each pose
    points: NDArray[np.float64]  # (H, 3) of the hits, metres, world frame
    ids: NDArray[np.int64]  # (H,) object that each hit, the lowest where several share a voxel
    frames: NDArray[np.int64]  # (H,) pose of each


@dataclass(frozen=True)
class Comparison:
    """All strategies on all layouts, and their disagreements."""

    layouts: tuple[LayoutFigures, ...]
    trace: Trace
    compared: int
    disagreed: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """One line: whether all results are equal."""
        if self.disagreed:
            return f"DISAGREED: {self.disagreed[0]} ({len(self.disagreed)} frames in all)"
        return (
            f"all agreed: hits, ids and wrench bit for bit, {len(COMPARED)} strategies on "
            f"{len(self.layouts)} layouts, {self.compared:,} frames compared"
        )

    def against_paper(self) -> str:
        """One line: `auto` on bricks against the paper's point queries on voxels."""
        known = {measured.imported.layout: measured for measured in self.layouts}
        ours, theirs = known["brick"].median_us("auto"), known["voxel"].median_us(YARDSTICK)
        return (
            f"auto on bricks against the paper's point queries on voxels: "
            f"{ours:.0f} µs to {theirs:.0f} µs, {theirs / ours:.1f} times as fast"
        )


def prepare(
    folder: str | os.PathLike[str],
    *,
    bits: int = 10,
    frames: int = 1000,
    points: int = 300,
    progress: ImportCallback | None = None,
) -> DemoScene:
    """Write the sample and import it in both layouts.

    folder : of all files; bits : of an axis of the grid; frames : poses of the path; points : of
    the tool's shell; progress : as for `hapticdb.import_files`.
    """
    options = GridOptions(bits=bits)
    home = Path(folder)
    files = write_sample(home, frames)
    shell = PointShell.from_file(files.spanner, points)
    layouts: tuple[tuple[Layout, str], ...] = (("brick", "car.db"), ("voxel", "car_voxel.db"))
    imported = [
        _import(str(home / name), files.car, layout, options, progress) for layout, name in layouts
    ]
    with open_environment(imported[0].url, read_only=True) as env:
        grid_text = env.grid.describe()
    poses = read_poses(files.path)
    return DemoScene(home, files, tuple(imported), shell, poses, grid_text)


def _import(
    url: str, car: Path, layout: Layout, grid: GridOptions, progress: ImportCallback | None
) -> Imported:
    started = time.perf_counter()
    options = ImportOptions(grid=grid, layout=layout)
    try:
        report = import_files(url, [car], options, progress)[0]
    except GridError as error:
        raise UsageError(f"{url} is of another demo: give another folder ({error})") from error
    seconds = time.perf_counter() - started
    with open_environment(url) as env:
        if env.store.size().rows:
            env.calibrate()
        size, objects = env.size(), env.objects()
    n_voxels = sum(obj.voxels for obj in objects)
    return Imported(
        layout, url, env.engine, seconds, len(objects), n_voxels, size.rows, size.bytes,
        bool(report.added),
    )  # fmt: skip


def compare(scene: DemoScene) -> Comparison:
    """Touch at every pose by every strategy on every layout; time and compare the results."""
    disagreed: list[str] = []
    layouts = []
    reference: list[Any] = []
    trace: Trace | None = None
    for imported in scene.imported:
        with open_environment(imported.url, read_only=True) as env:
            layouts.append(LayoutFigures(imported, _race(env, scene, reference, disagreed)))
            if trace is None:
                trace = _trace_of(env, scene.shell, scene.poses)
    assert trace is not None  # noqa: S101 - the demo has two layouts
    compared = len(scene.poses) * len(COMPARED) * len(layouts)
    return Comparison(tuple(layouts), trace, compared, tuple(disagreed))


def _race(
    env: Environment, scene: DemoScene, reference: list[Any], disagreed: list[str]
) -> dict[Strategy, list[Query]]:
    """Queries of each strategy; the first strategy's results become the `reference`."""
    for strategy in COMPARED:
        for pose in scene.poses[:: max(1, len(scene.poses) // WARM_POSES)]:
            env.touch(scene.shell, pose, strategy, law="plane")
    felt: dict[Strategy, list[Query]] = {strategy: [] for strategy in COMPARED}
    for index, pose in enumerate(scene.poses):
        # the first strategy at a pose brings its pages into the cache: they take turns at it
        turn = index % len(COMPARED)
        for strategy in COMPARED[turn:] + COMPARED[:turn]:
            touched = env.touch(scene.shell, pose, strategy, law="plane")
            felt[strategy].append(touched.query)
            found = _found(touched)
            if len(reference) == index:
                reference.append(found)
            elif found != reference[index]:
                disagreed.append(f"pose {index} by {strategy} on the {env.layout} layout")
    return felt


def _found(touched: Touch) -> tuple[bytes, bytes, bytes, tuple[int, ...]]:
    """Fields to be equal, bit for bit."""
    return (
        touched.force.tobytes(),
        touched.torque.tobytes(),
        touched.hits.tobytes(),
        tuple(obj.id for obj in touched.objects),
    )


def _trace_of(env: Environment, shell: PointShell, poses: NDArray[np.float64]) -> Trace:
    """Force, hits and their positions along a path."""
    force, hits, points, ids, frames = [], [], [], [], []
    for index, pose in enumerate(poses):
        touched = env.touch(shell, pose, law="plane")
        force.append(float(np.linalg.norm(touched.force)))
        hits.append(len(touched.hits))
        pairs = touched.pairs
        _, first = np.unique(pairs[:, 0], return_index=True)
        points.append(shell.points[pairs[first, 0]] @ pose[:3, :3].T + pose[:3, 3])
        ids.append(pairs[first, 1])
        frames.append(np.full(len(first), index, dtype=np.int64))
    return Trace(
        np.array(force),
        np.array(hits, dtype=np.int64),
        np.concatenate(points),
        np.concatenate(ids),
        np.concatenate(frames),
    )
