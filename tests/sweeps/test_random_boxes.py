"""Random rods, plates and cubes on random paths, against the exact distance of boxes.

Never a false clear: what comes out keeps at least the proved distance at every pose looked at.
Never a false hit: where a hit is told, the surfaces are within the tolerance at that very pose.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import hapticdb
from hapticdb import Environment, PointShell
from hapticdb.sweeps.result import Swept
from hapticdb.sweeps.run import sweep
from moving_boxes import Boxes, apart, distances, mesh

Floats = NDArray[np.float64]

SIZE = 0.01
ROUND = 1e-9
"""Metres: more than the rounding errors of the oracle."""
FILE = 1e-7
"""Metres: vertices in single precision, as the file has them, are as near to the exact ones."""
KINDS = {"rod": (0.4, 0.4, 8.0), "plate": (0.3, 6.0, 9.0), "cube": (3.0, 3.0, 3.0)}
"""Half edges in voxels, of the mean size."""


class Case(NamedTuple):
    """A tool with half edges (3,), metres, and the poses (M, 4, 4) of its path."""

    tool: Floats
    poses: Floats


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


def random_case(rng: np.random.Generator, objects: Boxes) -> Case:
    """A path of two or three poses; most paths are pushed until they nearly touch something."""
    tool = random_halves(rng)
    poses = np.stack([random_pose(rng, 0.05)] * rng.integers(1, 4))
    for pose in poses[1:]:
        pose[:3, 3] += rng.uniform(-0.06, 0.06, 3)
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.2, 3)).as_matrix() @ pose[:3, :3]
    out = rng.normal(size=3)
    out /= np.linalg.norm(out)
    wanted = SIZE * rng.uniform(-0.5, 2.0)
    near, far = 0.0, 0.8
    for _ in range(10):
        middle = 0.5 * (near + far)
        moved = poses.copy()
        moved[:, :3, 3] += middle * out
        is_free = apart(tool, moved, objects)[0].min() > max(wanted, 0.0)
        near, far = (near, middle) if is_free else (middle, far)
    poses[:, :3, 3] += (far + min(wanted, 0.0)) * out
    return Case(tool, poses)


@contextmanager
def scene(folder: Path, objects: Boxes, *, stored: bool) -> Iterator[Environment]:
    made = trimesh.Scene()
    for n, (pose, half) in enumerate(zip(*objects, strict=True)):
        made.add_geometry(mesh(half), node_name=f"box{n}", geom_name=f"box{n}", transform=pose)
    file = folder / "boxes.glb"
    file.write_bytes(made.export(file_type="glb"))
    grid = hapticdb.GridOptions(voxel_size=SIZE)
    url = folder / f"boxes{stored}.db"
    hapticdb.import_files(url, [file], hapticdb.ImportOptions(grid=grid, distances=stored))
    with hapticdb.open(url) as env:
        env.calibrate()  # once, and not at the start of each sweep
        yield env


def check(found: Swept, case: Case, objects: Boxes, tolerance: float | None) -> str:
    """Compare a sweep with the exact distances; returns the verdict."""
    path = found.path
    places = np.linspace(0.0, len(path) - 1.0, 2 * min(len(path), 60) - 1)
    exact, holds = apart(case.tool, path.at(places), objects)
    closest = places[int(exact.min(axis=1).argmin())]
    near = np.clip(closest + np.linspace(-2.0, 2.0, 33), 0.0, len(path) - 1.0)
    finer, _ = apart(case.tool, path.at(near), objects)
    least = min(float(exact.min()), float(finer.min()))
    limit = np.sqrt(3.0) * SIZE
    if found.verdict == "comes out":
        assert not holds.any()
        assert least > 0.0
        assert found.at_least <= least + FILE
    elif found.verdict == "hits" and not found.enclosed:
        if tolerance is not None:
            assert found.decision is not None
            assert found.decision.near is not None
            there = apart(case.tool, found.decision.near.pose[None], objects)[0].min()
            assert there <= found.decision.within + FILE <= min(tolerance, limit) + 2 * FILE
        else:
            assert found.first_hit is not None
            there = apart(case.tool, found.first_hit.pose[None], objects)[0].min()
            assert there <= limit + FILE
    elif found.enclosed:
        assert holds.any()
    elif found.decision is not None:
        assert least <= found.decision.within + FILE
    return found.verdict


def sweep_cases(folder: Path, seed: int, count: int, *, stored: bool) -> Counter[str]:
    """Sweep random tools in a random scene; returns how often each verdict came."""
    rng = np.random.default_rng(seed)
    objects = random_boxes(rng, 6)
    told: Counter[str] = Counter()
    made = folder / f"{seed}-{stored}"
    made.mkdir()
    with scene(made, objects, stored=stored) as env:
        assert env.has_distances == stored
        for n in range(count):
            case = random_case(rng, objects)
            box = mesh(case.tool)
            if n % 3:
                shell = PointShell.from_mesh(box.vertices, box.faces, spacing=0.5 * SIZE, seed=n)
            else:  # few points prove little by themselves
                shell = PointShell.from_mesh(box.vertices, box.faces, 40, seed=n)
            tolerance = None if n % 2 else 0.5 * SIZE
            found = sweep(env, shell, case.poses, tolerance=tolerance, refine=n % 4 > 1)
            told[check(found, case, objects, tolerance)] += 1
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
def test_random_boxes_never_come_out_or_hit_falsely(tmp_path: Path, *, stored: bool) -> None:
    """A hundred cases together."""
    told: Counter[str] = Counter()
    for seed in range(2):
        told += sweep_cases(tmp_path, seed, 25, stored=stored)
    assert min(told["comes out"], told["hits"]) >= 5
    assert told["not decided"] <= 30


@pytest.mark.long
@pytest.mark.parametrize("chunk", range(10))
def test_a_thousand_random_boxes_never_come_out_or_hit_falsely(tmp_path: Path, chunk: int) -> None:
    """A hundred cases a chunk: half of them with stored distances."""
    told: Counter[str] = Counter()
    for seed in range(2):
        for stored in (True, False):
            told += sweep_cases(tmp_path, 100 + 2 * chunk + seed, 25, stored=stored)
    assert sum(told.values()) == 100
    assert min(told["comes out"], told["hits"]) >= 10
