"""Tools that nearly touch, or touch between samples only, against the exact distance of boxes.

Never a false clear: what comes out keeps at least the proved distance at every pose looked at.
Never a false hit: where a hit is told, the surfaces are within the tolerance at that very pose.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import hapticdb
from draws import drawn, is_every
from hapticdb import Environment
from hapticdb.sweeps.run import sweep
from moving_boxes import Boxes, apart, distances, mesh
from tight_scenes import ORIGIN, SIZE, Oracle, check, frame_of, tight_scene, trial

Floats = NDArray[np.float64]

ROUND = 1e-9
"""Metres: more than the rounding errors of the oracle."""
KINDS = {"rod": (0.4, 0.4, 8.0), "plate": (0.3, 6.0, 9.0), "cube": (3.0, 3.0, 3.0)}
"""Half edges in voxels, of the mean size."""


def random_pose(rng: np.random.Generator, spread: float) -> Floats:
    pose = np.eye(4)
    turned = rng.random() < 0.7  # others lie along the axes, as most parts do
    pose[:3, :3] = Rotation.random(rng=rng).as_matrix() if turned else np.eye(3)
    pose[:3, 3] = rng.uniform(-spread, spread, 3)
    return pose


def random_halves(rng: np.random.Generator) -> Floats:
    kind = list(KINDS.values())[rng.integers(len(KINDS))]
    return SIZE * rng.permutation(np.array(kind) * rng.uniform(0.6, 1.5))


def random_boxes(rng: np.random.Generator, count: int) -> Boxes:
    poses = np.stack([random_pose(rng, 0.18) for _ in range(count)])
    return Boxes(poses, np.stack([random_halves(rng) for _ in range(count)]))


@contextmanager
def scene(
    folder: Path, objects: list[trimesh.Trimesh], grid: hapticdb.GridOptions, *, stored: bool
) -> Iterator[Environment]:
    made = trimesh.Scene()
    for n, one in enumerate(objects):
        made.add_geometry(one, node_name=f"box{n}", geom_name=f"box{n}")
    folder.mkdir()
    file = folder / "boxes.glb"
    file.write_bytes(made.export(file_type="glb"))
    url = folder / "boxes.db"
    hapticdb.import_files(url, [file], hapticdb.ImportOptions(grid=grid, distances=stored))
    with hapticdb.open(url) as env:
        env.calibrate()  # once, and not at the start of each sweep
        assert env.has_distances == stored
        yield env


def oracle_of(tool: Floats, objects: Boxes) -> Oracle:
    """Exact distances of a box with half edges (3,), metres."""

    def apart_at(poses: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        found, holds = apart(tool, poses, objects)
        return found.min(axis=1), np.asarray(holds.any(axis=1))

    return apart_at


def sweep_tight_cases(folder: Path, seed: int, count: int, *, stored: bool) -> Counter[str]:
    """Sweep tools that nearly touch, or touch between samples or points only."""
    rng = np.random.default_rng(seed)
    made = tight_scene(rng, [])
    frames = [frame_of(one) for one in made.objects]
    objects = Boxes(*(np.stack(arrays) for arrays in zip(*frames, strict=True)))
    grid = hapticdb.GridOptions(voxel_size=SIZE, bits=7, origin=ORIGIN)
    told: Counter[str] = Counter()
    with scene(folder / f"tight{seed}-{stored}", made.objects, grid, stored=stored) as env:
        for n in range(count):
            case = trial(rng, made, n)
            tolerance = None if n % 2 else 0.5 * SIZE
            found = sweep(env, case.shell, case.poses, tolerance=tolerance, refine=n % 4 > 1)
            oracle = oracle_of(frame_of(case.tool)[1], objects)
            told[check(found, case.poses, case.shell, oracle, tolerance)] += 1
    return told


def test_the_oracle_agrees_with_points_spread_over_both_boxes() -> None:
    rng = np.random.default_rng(8)
    one, other = random_boxes(rng, 24), random_boxes(rng, 24)
    exact, _ = distances(one, other)
    assert (exact == 0.0).any()
    assert (exact > 0.0).sum() > 10
    fine = 0.5 * SIZE
    for n in range(24):
        clouds = []
        for boxes in (one, other):
            made = mesh(boxes.halves[n])
            vertices, _ = trimesh.remesh.subdivide_to_size(made.vertices, made.faces, fine)
            clouds.append(trimesh.transform_points(vertices, boxes.poses[n]))
        sampled = float(np.min(cKDTree(clouds[0]).query(clouds[1])[0]))
        assert exact[n] - ROUND <= sampled <= exact[n] + 2.0 * fine


@pytest.mark.parametrize("stored", [True, False], ids=["distances", "voxels"])
def test_tight_boxes_never_come_out_or_hit_falsely(tmp_path: Path, *, stored: bool) -> None:
    """Each kind of trial."""
    told = sweep_tight_cases(tmp_path, 1, 7, stored=stored)
    assert min(told["comes out"], told["hits"]) >= 1


@pytest.mark.long
@pytest.mark.parametrize("chunk", drawn(range(10), 1))
def test_a_thousand_random_boxes_never_come_out_or_hit_falsely(tmp_path: Path, chunk: int) -> None:
    """A hundred cases a chunk, of which a run without --every-step tries forty; half of them with
    stored distances."""
    told: Counter[str] = Counter()
    n_cases = 50 if is_every() else 20
    for stored in (True, False):
        told += sweep_tight_cases(tmp_path, 100 + chunk, n_cases, stored=stored)
    assert sum(told.values()) == 2 * n_cases
    assert min(told["comes out"], told["hits"]) >= n_cases // 5
