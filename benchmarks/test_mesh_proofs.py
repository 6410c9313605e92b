"""Clashes of meshes against coal's distance of the triangles; open shapes for `truth`.

coal is asked in millimetres: in metres it is wrong for triangles of a tenth of a millimetre. Its
distances are real ones, but for some pairs of edges that are almost parallel they are too large;
the bounds of hapticdb must be below them in any case.
"""

import os
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import hapticdb
from batch_peers import tree_of_boxes
from hapticdb.ingest.geometry import parts_of

if "CI" in os.environ:
    import coal
else:
    coal = pytest.importorskip("coal", reason="make peers installs it")

Floats = NDArray[np.float64]

MM = 1e3
FILES = ("demo_vintage_car/vintage_car.glb", "assembly_vw_t1/vw_t1.glb")
L_FACES = [(3, 4, 5), (3, 5, 0), (3, 0, 1), (3, 1, 2)]
U_FACES = [(4, 1, 2), (4, 2, 3), (5, 6, 7), (5, 7, 0), (0, 1, 4), (0, 4, 5)]
"""Triangles of the outlines' insides; they use the outlines' corners alone."""


def coal_distance(one: Any, other: Any, pose: Floats) -> float:  # noqa: ANN401 - coal has no types
    """Distance, metres, of trees in millimetres, the other one at a pose (4, 4) in metres."""
    there = coal.Transform3s(pose[:3, :3].copy(), MM * pose[:3, 3])
    sides = (one, coal.Transform3s(), other, there)
    return (
        max(float(coal.distance(*sides, coal.DistanceRequest(), coal.DistanceResult())), 0.0) / MM
    )


def tree_in_mm(triangles: Floats) -> Any:  # noqa: ANN401
    return tree_of_boxes(
        MM * triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)
    )


def prism(outline: Sequence[tuple[float, float]], faces: list[Any], high: float) -> trimesh.Trimesh:
    """A closed prism over an outline, counterclockwise, cm, its middle at 0."""
    flat, count = np.array(outline), len(outline)
    flat -= 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    corners = [np.column_stack([flat, np.full(count, z)]) for z in (-0.5 * high, 0.5 * high)]
    top = np.array(faces) + count
    here = np.arange(count)
    there = (here + 1) % count
    sides = [(here, there, there + count), (here, there + count, here + count)]
    triangles = [np.array(faces)[:, ::-1], top, *(np.stack(side, axis=1) for side in sides)]
    return trimesh.Trimesh(0.01 * np.concatenate(corners), np.concatenate(triangles), process=False)


def bracket(rng: np.random.Generator) -> trimesh.Trimesh:
    """An L."""
    t, h, w = rng.uniform(0.4, 2.5), rng.uniform(5.0, 9.0), rng.uniform(2.6, 6.0)
    return prism([(0, 0), (w, 0), (w, t), (t, t), (t, h), (0, h)], L_FACES, rng.uniform(0.5, 6.0))


def clamp(rng: np.random.Generator) -> trimesh.Trimesh:
    """A U; the space in it is open, and no inside."""
    t, h = rng.uniform(0.4, 2.0), rng.uniform(4.0, 8.0)
    w = 2.0 * t + rng.uniform(2.0, 4.0)
    outline = [(0, 0), (w, 0), (w, h), (w - t, h), (w - t, t), (t, t), (t, h), (0, h)]
    return prism(outline, U_FACES, rng.uniform(0.5, 6.0))


ASSEMBLIES = (*FILES, "robot_lekiwi/lekiwi.glb")
WITHIN = 1e-3


@pytest.mark.parametrize("name", ASSEMBLIES)
def test_find_clashes_all_pairs_against_coal(tmp_path: Path, name: str) -> None:
    """All pairs of near boxes: none is lost, none invented, distances are the same to 1e-6 mm."""
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=5), distances=False)
    file = Path(os.environ["HAPTICDB_TEST_DATA"], name)
    hapticdb.import_files(tmp_path / "e.db", [file], options)
    with hapticdb.open(tmp_path / "e.db") as env:
        parts = list(parts_of(env.store, env.objects()))
        told = {one[:2]: one for one in hapticdb.find_clashes(env, within=WITHIN).pairs}
    trees = {obj.id: tree_in_mm(part.triangles(obj.transform)) for obj, part in parts}
    boxes = {obj.id: obj.bounds for obj, _ in parts}
    n_equal, n_near, here = 0, 0, np.eye(4)
    for a, b in combinations(sorted(boxes), 2):
        apart = np.maximum(boxes[a][0] - boxes[b][1], boxes[b][0] - boxes[a][1]).max()
        if apart > WITHIN:
            assert (a, b) not in told
            continue
        peer = coal_distance(trees[a], trees[b], here)
        one = told.pop((a, b), None)
        if one is None:
            assert peer > WITHIN - 1e-9
            continue
        if one.kind == "inside":
            continue
        gap = 0.0 if one.kind == "overlapping" else one.at_least
        assert gap <= peer + 1e-9
        n_near, n_equal = n_near + 1, n_equal + (peer - gap <= 1e-9)
    assert not told
    assert n_equal >= 0.999 * n_near
