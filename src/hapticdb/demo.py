"""The demo: four answers about the sample car, then its frames under every strategy.

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

from hapticdb.clashes.groups import groups_of
from hapticdb.clashes.rules import add_rules
from hapticdb.clashes.search import WITHIN, find_clashes
from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import GridError, UsageError
from hapticdb.extraction.removal_search import extract
from hapticdb.extraction.verdict import extraction_line
from hapticdb.grid import GridOptions
from hapticdb.ingest.files import ImportCallback, ImportOptions, import_files
from hapticdb.paper.strategies import Strategy
from hapticdb.pointshell.shell import PointShell
from hapticdb.poses import read_poses
from hapticdb.query.touches import Query, Touch
from hapticdb.sample import SampleFiles, write_sample
from hapticdb.store.base import Layout
from hapticdb.units import length_text

COMPARED: tuple[Strategy, ...] = ("statement", "points", "array", "maxgap", "cbgroup", "auto")
YARDSTICK: Strategy = "points"
"""The paper's point query sequence, the reference of the comparison."""


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
    """Files of the demo, and its environment on bricks."""

    folder: Path
    files: SampleFiles
    grid: GridOptions
    imported: Imported
    shell: PointShell
    poses: NDArray[np.float64]
    grid_text: str


class Answers(NamedTuple):
    """An answer of each kind about the car, and the figures of the picture."""

    lines: tuple[tuple[str, str], ...]
    lid: NDArray[np.float64]  # (M, 4, 4) displacements of the trunk lid
    force: NDArray[np.float64]  # (M,) newtons along the path of the tool
    hits: NDArray[np.int64]  # (M,) number at each pose


@dataclass(frozen=True)
class LayoutFigures:
    """Query figures of all strategies on one layout, pose by pose."""

    imported: Imported
    queries: dict[Strategy, list[Query]]

    def median_us(self, strategy: Strategy) -> float:
        """Median time of a strategy's frames, microseconds."""
        return float(np.median([query.elapsed_us for query in self.queries[strategy]]))


@dataclass(frozen=True)
class Comparison:
    """All strategies on all layouts, and their disagreements."""

    layouts: tuple[LayoutFigures, ...]
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
    folder: str | os.PathLike[str], *, bits: int = 10, frames: int = 1000, points: int = 300,
    progress: ImportCallback | None = None,
) -> DemoScene:  # fmt: skip
    """Write the sample and import it on bricks.

    folder : of all files; bits : of an axis of the grid; frames : poses of the path; points : of
    the tool's shell; progress : as for `hapticdb.import_files`.
    """
    grid = GridOptions(bits=bits)
    home = Path(folder)
    files = write_sample(home, frames)
    imported = _import(str(home / "car.db"), files.car, "brick", grid, progress)
    with open_environment(imported.url, read_only=True) as env:
        shell, grid_text = env.tool(files.spanner, points), env.grid.describe()
    return DemoScene(home, files, grid, imported, shell, read_poses(files.path), grid_text)


def answers(scene: DemoScene) -> Answers:
    """Find clashes, a distance, a removal path and forces."""
    with open_environment(scene.imported.url) as env:
        add_rules(env.store, (), WITHIN, scene.files.rules)
        groups = [one for one in groups_of(env.store, find_clashes(env).pairs) if one.is_open]
        apart = env.distance("body/hood", "body/windscreen")
        found = extract(env, "body/trunk_lid")
        queries = env.touch(scene.shell, poses=scene.poses)
    force = np.linalg.norm(queries.forces, axis=1)
    clashes = (f"{one.title()}: {one.kind}, {one.length_text()}" for one in groups)
    lines = (
        ("what clashes?", "; ".join(clashes)),
        ("does it fit?", f"hood and windscreen are {length_text(apart.at_most)} apart"),
        ("does it come out?", f"the trunk lid {extraction_line(found)}"),
        ("how does it feel?", f"a spanner pushed 1 mm into the car: up to {force.max():.3g} N"),
    )
    lid = np.eye(4)[None] if found.path is None else found.path.poses
    return Answers(lines, lid, force, queries.hits)


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


def compare(scene: DemoScene, progress: ImportCallback | None = None) -> Comparison:
    """Touch at every pose by every strategy on both layouts; time and compare the results."""
    url = str(scene.folder / "car_voxel.db")
    voxels = _import(url, scene.files.car, "voxel", scene.grid, progress)
    disagreed: list[str] = []
    layouts = []
    reference: list[Any] = []
    for imported in (scene.imported, voxels):
        with open_environment(imported.url, read_only=True) as env:
            layouts.append(LayoutFigures(imported, _race(env, scene, reference, disagreed)))
    compared = len(scene.poses) * len(COMPARED) * len(layouts)
    return Comparison(tuple(layouts), compared, tuple(disagreed))


def _race(
    env: Environment, scene: DemoScene, reference: list[Any], disagreed: list[str]
) -> dict[Strategy, list[Query]]:
    """Queries of each strategy; the first strategy's results become the `reference`."""
    for strategy in COMPARED:
        for pose in scene.poses[:: max(1, len(scene.poses) // 20)]:
            env.touch(scene.shell, pose, strategy, law="plane")
    queries: dict[Strategy, list[Query]] = {strategy: [] for strategy in COMPARED}
    for index, pose in enumerate(scene.poses):
        # the first strategy at a pose brings its pages into the cache: they take turns at it
        turn = index % len(COMPARED)
        for strategy in COMPARED[turn:] + COMPARED[:turn]:
            touched = env.touch(scene.shell, pose, strategy, law="plane")
            queries[strategy].append(touched.query)
            found = _found(touched)
            if len(reference) == index:
                reference.append(found)
            elif found != reference[index]:
                disagreed.append(f"pose {index} by {strategy} on the {env.layout} layout")
    return queries


def _found(touched: Touch) -> tuple[bytes, bytes, bytes, tuple[int, ...]]:
    """Fields to be equal, bit for bit."""
    return (
        touched.force.tobytes(),
        touched.torque.tobytes(),
        touched.hits.tobytes(),
        tuple(obj.id for obj in touched.objects),
    )
