"""Time of one frame: every strategy and layout, beside a lower bound and a plain program.

The lower bound is a dense in-memory bitmap with the same kernels. The plain program, without
hapticdb, sends one warm statement a shell point through the standard library's ``sqlite3`` on the
voxel layout. Each round is one pass over all poses, so that no pose stays in a processor's cache;
`us_per_frame` in the extra info is the median round divided by the number of poses.

    make bench                      # the sample at 11 bits: about 13.5 million object voxels
"""

import sqlite3
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from hapticdb.query.frame import STRATEGIES, Strategy
from hapticdb.store.base import LAYOUTS, Layout
from peers import PeerWork, Pose
from peers.memory import DenseBitmap
from scene import BenchScene, is_measuring

ROUNDS = 10
CACHE_KIB = 256 * 1024
"""Page cache of the plain program in KiB: large enough for the whole database."""


def measure(
    benchmark: BenchmarkFixture, scene: BenchScene, frame: Callable[[Pose], object], group: str
) -> None:
    """Time passes over all poses, after two passes of warm-up."""

    def all_poses() -> None:
        for pose in scene.poses:
            frame(pose)

    benchmark.group = group
    benchmark.pedantic(all_poses, rounds=ROUNDS, warmup_rounds=2)
    if benchmark.stats is not None:
        per_frame = benchmark.stats.stats.median / len(scene.poses) * 1e6
        benchmark.extra_info["us_per_frame"] = round(per_frame, 1)
    env = scene.environments["brick"]
    benchmark.extra_info["object_voxels"] = sum(obj.voxels for obj in env.objects())


@pytest.fixture(scope="module")
def dense(scene: BenchScene, tmp_path_factory: pytest.TempPathFactory) -> Iterator[DenseBitmap]:
    env, folder = scene.environments["brick"], tmp_path_factory.mktemp("dense")
    bitmap = DenseBitmap()
    bitmap.build(PeerWork.of_sample(env, scene.shell, scene.files, folder))
    yield bitmap
    bitmap.close()


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_touch(
    benchmark: BenchmarkFixture, scene: BenchScene, strategy: Strategy, layout: Layout
) -> None:
    env = scene.environments[layout]
    env.calibrate(keep=False)
    measure(benchmark, scene, lambda pose: env.touch(scene.shell, pose, strategy), "frame")
    queries = [env.touch(scene.shell, pose, strategy).query for pose in scene.poses]
    for name in ("statements", "ranges", "rows"):
        benchmark.extra_info[name] = float(np.mean([getattr(q, name) for q in queries]))
    other = scene.environments["voxel" if layout == "brick" else "brick"]
    for pose in scene.poses[::20]:
        found = env.touch(scene.shell, pose, strategy)
        wanted = other.touch(scene.shell, pose, "array")
        assert found.force.tobytes() == wanted.force.tobytes()
        assert found.torque.tobytes() == wanted.torque.tobytes()
        assert found.hits.tolist() == wanted.hits.tolist()


def test_dense_bitmap(benchmark: BenchmarkFixture, scene: BenchScene, dense: DenseBitmap) -> None:
    measure(benchmark, scene, dense.felt, "frame")
    for pose in scene.poses[::20]:
        touch = scene.environments["brick"].touch(scene.shell, pose)
        n_hits, wrench = dense.felt(pose)
        assert n_hits == len(touch.hits)
        assert wrench[:3].tobytes() == touch.force.tobytes()


def point_statements(scene: BenchScene, cache_kib: int) -> Callable[[Pose], int]:
    """A frame of one warm statement a shell point by ``sqlite3``; the keys are computed before."""
    env = scene.environments["voxel"]
    connection = sqlite3.connect(f"{Path(env.url).resolve().as_uri()}?mode=ro", uri=True)
    connection.execute(f"PRAGMA cache_size = -{cache_kib}")
    cursor = connection.cursor()
    asked: dict[bytes, list[int]] = {}
    for pose in scene.poses:
        voxels = env.grid.voxels_of(scene.shell.points @ pose[:3, :3].T + pose[:3, 3])
        inside = voxels[env.grid.contains(voxels)]
        asked[pose.tobytes()] = env.grid.encode(inside).tolist()

    def look_up(pose: Pose) -> int:
        found = 0
        for key in asked[pose.tobytes()]:
            row = cursor.execute("SELECT id FROM voxel WHERE z_val = ?", (key,)).fetchone()
            found += row is not None
        return found

    return look_up


@pytest.mark.parametrize("cache_kib", [2000, CACHE_KIB], ids=["default cache", "all cached"])
def test_one_statement_a_point_by_the_standard_library(
    benchmark: BenchmarkFixture, scene: BenchScene, cache_kib: int
) -> None:
    look_up = point_statements(scene, cache_kib)
    measure(benchmark, scene, look_up, "frame")
    env = scene.environments["voxel"]
    for pose in scene.poses[::20]:
        assert look_up(pose) == len(env.touch(scene.shell, pose).hits)


def test_touch_and_one_statement_a_point_in_turns(
    benchmark: BenchmarkFixture, scene: BenchScene, pytestconfig: pytest.Config
) -> None:
    """Passes alternate; the median of their ratios does not depend on drifts of machine speed."""
    env = scene.environments["brick"]
    look_up = point_statements(scene, CACHE_KIB)

    def seconds(frame: Callable[[Pose], object]) -> float:
        start = time.perf_counter()
        for pose in scene.poses:
            frame(pose)
        return time.perf_counter() - start

    def touch(pose: Pose) -> object:
        return env.touch(scene.shell, pose, "array")

    for pose in scene.poses[::20]:  # both find the same hits
        assert look_up(pose) == len(env.touch(scene.shell, pose, "array").hits)
    rounds = 2 + (2 * ROUNDS if is_measuring(pytestconfig) else 1)
    ratios: list[float] = []

    def pairs() -> None:
        ratios[:] = [seconds(look_up) / seconds(touch) for _ in range(rounds)][2:]

    benchmark.group = "in turns"
    benchmark.pedantic(pairs, rounds=1)
    low, middle, high = np.percentile(ratios, [10, 50, 90])
    benchmark.extra_info["times_faster"] = f"{middle:.1f} ({low:.1f} to {high:.1f})"
