"""What sweeps prove of L- and U-shaped parts, against coal's exact distance of the triangles.

The trials are those of tests/tight_scenes.py with L- and U-shaped tools and objects among the rods,
plates and cubes. No voxels, points or bounds of hapticdb take part in coal's answer, and the poses
at which it is asked come from plain formulas.
"""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import hapticdb
from batch_peers import tree_of_boxes
from hapticdb.sweeps.run import sweep
from tight_scenes import (
    ORIGIN,
    SIZE,
    TightScene,
    Trial,
    check,
    hole,
    past_edge,
    pose_with,
    rod,
    shell_of,
    shifted,
    through,
    tight_scene,
)

if "CI" in os.environ:
    import coal
else:
    coal = pytest.importorskip("coal", reason="make peers installs it")

Floats = NDArray[np.float64]

L_FACES = [(3, 4, 5), (3, 5, 0), (3, 0, 1), (3, 1, 2)]
U_FACES = [(4, 1, 2), (4, 2, 3), (5, 6, 7), (5, 7, 0), (0, 1, 4), (0, 4, 5)]
"""Triangles of the outlines' insides; they use the outlines' corners alone."""
TOLERANCE = 0.5 * SIZE


def prism(outline: Sequence[tuple[float, float]], faces: list[Any], high: float) -> trimesh.Trimesh:
    """A closed prism over an outline, counterclockwise; lengths in voxels, its middle at 0."""
    flat, count = np.array(outline), len(outline)
    flat -= 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    corners = [np.column_stack([flat, np.full(count, z)]) for z in (-0.5 * high, 0.5 * high)]
    top = np.array(faces) + count
    here = np.arange(count)
    there = (here + 1) % count
    sides = [(here, there, there + count), (here, there + count, here + count)]
    triangles = [np.array(faces)[:, ::-1], top, *(np.stack(side, axis=1) for side in sides)]
    return trimesh.Trimesh(SIZE * np.concatenate(corners), np.concatenate(triangles), process=False)


def bracket(rng: np.random.Generator, *, slim: bool = False) -> trimesh.Trimesh:
    """An L."""
    t, h = rng.uniform(0.4, 0.8) if slim else rng.uniform(1.0, 2.5), rng.uniform(5.0, 9.0)
    w, high = rng.uniform(2.0, 6.0), t if slim else rng.uniform(0.5, 6.0)
    return prism([(0, 0), (w, 0), (w, t), (t, t), (t, h), (0, h)], L_FACES, high)


def clamp(rng: np.random.Generator, *, slim: bool = False) -> trimesh.Trimesh:
    """A U; the space in it is open, and no inside."""
    t, h = rng.uniform(0.4, 0.8) if slim else rng.uniform(1.0, 2.0), rng.uniform(4.0, 8.0)
    w, high = 2.0 * t + rng.uniform(2.0, 4.0), t if slim else rng.uniform(0.5, 6.0)
    outline = [(0, 0), (w, 0), (w, h), (w - t, h), (w - t, t), (t, t), (t, h), (0, h)]
    return prism(outline, U_FACES, high)


def clamp_at_nut(rng: np.random.Generator, scene: TightScene) -> Trial:
    """A thick clamp with a small object inside one leg, or free between both."""
    t, wide = rng.uniform(3.5, 5.0), rng.uniform(6.0, 9.0)
    w, h = 2.0 * t + wide, t + rng.uniform(6.0, 9.0)
    outline = [(0, 0), (w, 0), (w, h), (w - t, h), (w - t, t), (t, t), (t, h), (0, h)]
    tool = prism(outline, U_FACES, rng.uniform(3.5, 6.0))
    shell = shell_of(tool, int(rng.integers(99)), spacing=0.6 * SIZE)
    local = SIZE * np.array([rng.choice([0.0, 0.5 * (t + wide)]), 0.5 * t + rng.uniform(-1, 1), 0])
    place = np.asarray(scene.objects[rng.choice(scene.nuts)].bounds.mean(axis=0))
    pose = pose_with(Rotation.random(rng=rng).as_matrix(), local, place)
    end = shifted(pose, SIZE * rng.uniform(-0.4, 0.4, 3))
    return Trial("clamp at nut", tool, shell, np.array([pose, end]))


class ExactMeshes:
    """An oracle of tests/tight_scenes.py: coal's distance, and solid angles for what is inside."""

    def __init__(self, tool: trimesh.Trimesh, objects: Sequence[trimesh.Trimesh]) -> None:
        self._tool, self._objects = _tree(tool), [_tree(one) for one in objects]
        self._triangles = np.asarray(tool.triangles)
        self._firsts = np.array([one.vertices[0] for one in objects])
        self._here, self._request = coal.Transform3s(), coal.DistanceRequest()

    def __call__(self, poses: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        found = np.empty((len(poses), len(self._objects)))
        for n, pose in enumerate(poses):
            there = coal.Transform3s(pose[:3, :3].copy(), pose[:3, 3].copy())
            for m, one in enumerate(self._objects):
                result = coal.DistanceResult()
                apart = coal.distance(one, self._here, self._tool, there, self._request, result)
                found[n, m] = max(float(apart), 0.0)
        # where surfaces are apart, one place of an object tells of all of them
        local = (self._firsts - poses[:, None, :3, 3]) @ poses[:, :3, :3]
        inside = np.abs(windings(self._triangles, local.reshape(-1, 3))) > 0.5
        holds = inside.reshape(found.shape) & (found > 0.0)
        return found.min(axis=1), np.asarray(holds.any(axis=1))


def windings(triangles: Floats, places: Floats) -> Floats:
    """How often closed triangles (F, 3, 3) wind about places (Q, 3), by their solid angles."""
    a, b, c = (triangles[None, :, n] - places[:, None] for n in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    volume = (a * np.cross(b, c)).sum(axis=2)
    below = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return np.asarray(np.arctan2(volume, below).sum(axis=1) / (2.0 * np.pi))


def _tree(mesh: trimesh.Trimesh) -> Any:  # noqa: ANN401 - coal has no types
    return tree_of_boxes(np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces))


def trial_of_meshes(rng: np.random.Generator, scene: TightScene, n: int) -> Trial:
    """The n-th trial: slim shapes pass edges, others are pierced, or fly through objects."""
    shape = (bracket, clamp)[rng.integers(2)]
    slim = rod(rng) if rng.random() < 0.3 else shape(rng, slim=True)
    block = shape(rng)
    kinds = [
        lambda: hole(rng, scene, block),
        lambda: past_edge(rng, scene, slim),
        lambda: through(rng, scene, block),
        lambda: past_edge(rng, scene, slim),
        lambda: clamp_at_nut(rng, scene),
    ]
    return kinds[n % len(kinds)]()


def sweep_meshes(folder: Path, seed: int, trials: int, *, stored: bool) -> Counter[str]:
    """Sweep in one scene; raises AssertionError at the first wrong verdict."""
    rng = np.random.default_rng(seed)
    others = [bracket(rng), clamp(rng), bracket(rng, slim=True), clamp(rng, slim=True)]
    scene = tight_scene(rng, others)
    made = trimesh.Scene()
    for n, one in enumerate(scene.objects):
        made.add_geometry(one, node_name=f"part{n}", geom_name=f"part{n}")
    file = folder / f"{seed}.glb"
    file.write_bytes(made.export(file_type="glb"))
    url = folder / f"{seed}.db"
    grid = hapticdb.GridOptions(voxel_size=SIZE, bits=7, origin=ORIGIN)
    hapticdb.import_files(url, [file], hapticdb.ImportOptions(grid=grid, distances=stored))
    told: Counter[str] = Counter()
    with hapticdb.open(url) as env:
        env.calibrate()
        for n in range(trials):
            case = trial_of_meshes(rng, scene, n)
            exact = ExactMeshes(case.tool, scene.objects)
            tolerance = None if n % 2 else TOLERANCE
            found = sweep(env, case.shell, case.poses, tolerance=tolerance, refine=n % 4 > 1)
            told[check(found, case.poses, case.shell, exact, tolerance)] += 1
    return told


@pytest.mark.parametrize("seed", [0, 1])
def test_meshes_never_come_out_or_hit_falsely(tmp_path: Path, seed: int) -> None:
    """Tight trials in a scene without, and in one with stored distances."""
    told = sweep_meshes(tmp_path, seed, 20, stored=bool(seed))
    assert min(told["comes out"], told["hits"]) >= 1
