"""Paths of boxes, against the exact distance of boxes: no false clear, no false hit, true gaps."""

import time

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from draws import drawn
from hapticdb import PointShell
from hapticdb.exact.distance import OverTimeError, Pair, error_of
from hapticdb.exact.path import ToolPath
from hapticdb.kernels.surfaces.triangle_bvh import TriangleBVH, triangle_bvh
from hapticdb.kernels.triangles.path_distance import MEETING
from hapticdb.pointshell.tool_surface import ToolSurface
from moving_boxes import Boxes, distances, mesh
from naive_motion import poses_at

Floats = NDArray[np.float64]

KINDS = {"rod": (0.4, 0.4, 8.0), "plate": (0.3, 6.0, 9.0), "cube": (3.0, 3.0, 3.0)}
"""Half edges, cm."""
PLACES = 400
"""Places of a path at which the oracle looks."""


def random_boxes(rng: np.random.Generator, spread: float) -> Boxes:
    pose = np.eye(4)
    if rng.random() < 0.7:  # others lie along the axes, as most parts do
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
    pose[:3, 3] = rng.uniform(-spread, spread, 3)
    kind = list(KINDS.values())[rng.integers(len(KINDS))]
    return Boxes(pose[None], 0.01 * rng.permutation(kind)[None] * rng.uniform(0.6, 1.5))


def bvh_of(boxes: Boxes) -> TriangleBVH:
    triangles = np.array(mesh(boxes.halves[0]).triangles)
    pose = boxes.poses[0]
    triangles = triangles @ pose[:3, :3].T + pose[:3, 3]
    return triangle_bvh(triangles, np.zeros(len(triangles), dtype=np.int64))


def tool_of(boxes: Boxes) -> ToolSurface:
    made = mesh(boxes.halves[0])
    return ToolSurface(PointShell.from_mesh(made.vertices, made.faces, 10))


def random_path(rng: np.random.Generator) -> Floats:
    poses: list[Floats] = []
    for _ in range(int(rng.integers(2, 5))):
        pose = np.eye(4)
        if poses and rng.random() < 0.3:
            pose[:3, :3] = poses[-1][:3, :3]
        else:
            pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.uniform(-0.25, 0.25, 3)
        poses.append(pose)
    return np.array(poses)


def check_a_path(rng: np.random.Generator) -> str:
    """Sweep a box past another; returns what was told."""
    still, tool = random_boxes(rng, 0.05), random_boxes(rng, 0.0)._replace(poses=np.eye(4)[None])
    poses, center = random_path(rng), rng.uniform(-0.02, 0.02, 3)
    way = ToolPath.of(poses, tool.corners()[0], center)
    pair = Pair(bvh_of(still), tool_of(tool), way)
    found, closed = pair.least(0.0, np.inf)
    assert found is not None
    times = np.linspace(0.0, len(poses) - 1.0, PLACES)
    placed = Boxes(poses_at(poses, center, times), np.repeat(tool.halves, PLACES, axis=0))
    others = Boxes(np.repeat(still.poses, PLACES, axis=0), np.repeat(still.halves, PLACES, axis=0))
    exact, _ = distances(others, placed)
    here = Boxes(way.at([found.parameter]), tool.halves)
    at_place = float(distances(still, here)[0][0])
    assert at_place == pytest.approx(found.at_most, abs=1e-9)
    if found.at_most <= MEETING:
        if found.parameter > MEETING:
            before = way.at(np.linspace(0.0, found.parameter - MEETING, PLACES))
            earlier = distances(others, Boxes(before, placed.halves))[0]
            assert earlier.min() >= 0.5 * MEETING - 1e-9
        return "hits"
    assert closed - 1e-9 <= exact.min()
    assert found.at_most - closed <= error_of(found.at_most) + 1e-12
    return "clear"


@pytest.mark.parametrize(
    ("seed", "n"),
    [
        *((seed, 20) for seed in range(2)),
        *(pytest.param(seed, 50, marks=pytest.mark.long) for seed in drawn(range(100, 120), 2)),
    ],
)
def test_least_random_box_paths_against_exact_boxes(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    told = [check_a_path(rng) for _ in range(n)]
    assert min(told.count("hits"), told.count("clear")) >= n / 10


@pytest.mark.parametrize("gap", [5e-5, 4e-4, 8e-3])
def test_least_sliding_box_gap(gap: float) -> None:
    still = Boxes(np.eye(4)[None], np.array([[0.3, 0.05, 0.02]]))
    tool = Boxes(np.eye(4)[None], np.array([[0.02, 0.02, 0.02]]))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [[-0.2, 0.0, 0.04 + gap], [0.2, 0.01, 0.04 + gap]]
    pair = Pair(bvh_of(still), tool_of(tool), ToolPath.of(poses, tool.corners()[0], np.zeros(3)))
    found, closed = pair.least(0.0, np.inf)
    assert found is not None
    assert found.at_most == pytest.approx(gap, rel=1e-9)
    assert gap - error_of(gap) - 1e-12 <= closed <= gap


def test_least_ball_closed_form() -> None:
    still = Boxes(np.eye(4)[None], np.array([[0.1, 0.1, 0.1]]))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = [[0.3, 0.0, 0.0], [0.15, 0.02, 0.0]]
    way = ToolPath.of(poses, np.array([[-0.03] * 3, [0.03] * 3]), np.zeros(3))
    pair = Pair(bvh_of(still), ToolSurface(PointShell.sphere(0.03)), way)
    found, _ = pair.least(0.0, np.inf)
    assert found is not None
    assert found.at_most == pytest.approx(0.02, rel=0.01)
    assert np.allclose(found.on_tool, [0.12, 0.02, 0.0], atol=3e-4)
    assert np.allclose(found.on_object, [0.1, 0.02, 0.0], atol=3e-4)


def test_least_time_limit() -> None:
    still = Boxes(np.eye(4)[None], np.array([[0.1, 0.1, 0.1]]))
    way = ToolPath.of(np.tile(np.eye(4), (2, 1, 1)), np.zeros((1, 3)), np.zeros(3))
    pair = Pair(bvh_of(still), tool_of(still), way, time.monotonic() - 1.0)
    with pytest.raises(OverTimeError):
        pair.least(0.0, np.inf)
