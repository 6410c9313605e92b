"""Sweeps of single primitives, against exact answers of a public set of queries.

Continuous-Collision-Detection/Sample-Queries, the queries in which a vertex only shifts past a
triangle, or an edge past an edge; their answers were computed in rational arithmetic.
"""

import csv
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from hapticdb.exact.distance import Pair
from hapticdb.exact.path import ToolPath
from hapticdb.kernels.surfaces.triangle_bvh import triangle_bvh
from hapticdb.kernels.triangles.path_distance import MEETING
from hapticdb.pointshell.shape import CollisionShape
from hapticdb.pointshell.tool_surface import ToolSurface

Floats = NDArray[np.float64]


class Primitive(ToolSurface):
    """A triangle (3, 3); of an edge or a vertex, with corners that coincide."""

    def __init__(self, corners: Floats) -> None:
        CollisionShape.__init__(self, corners[None])
        self.corners = corners


def distance(to: Floats, *sides: Floats) -> tuple[float, Floats]:
    """Distance of a point (3,) from sums of sides (3,) by shares 0 .. 1, and the shares."""
    columns = np.stack(sides, axis=1)
    shares = lsq_linear(columns, to, bounds=(0.0, 1.0), method="bvls", tol=1e-15).x
    return float(np.linalg.norm(columns @ shares - to)), shares


def least(is_edges: bool, p: Floats, shift: Floats) -> float:
    """Least distance in the motion: a convex problem."""
    if is_edges:
        return distance(p[2] - p[0], p[1] - p[0], shift, p[2] - p[3])[0]
    found, shares = distance(p[1] - p[0], shift, p[1] - p[2], p[1] - p[3])
    if shares[1] + shares[2] <= 1.0:
        return found
    return distance(p[2] - p[0], shift, p[2] - p[3])[0]  # beyond the far edge of the triangle


def test_sweep_sample_queries_no_missed_collision(real_files: Path) -> None:
    """A false one is nearer than the tolerance, 0.01 mm, with coordinates taken as metres."""
    counts: Counter[tuple[bool, bool]] = Counter()
    with (real_files / "ccd" / "translations.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        p = np.array([[float(row[f"{axis}p{n}"]) for axis in "xyz"] for n in range(4)])
        poses = np.tile(np.eye(4), (2, 1, 1))
        shift = poses[1, :3, 3] = [float(row[f"d{axis}"]) for axis in "xyz"]
        is_edges, is_hit = row["kind"] == "edge-edge", row["hit"] == "1"
        moving, still = (p[[0, 1, 1]], p[[2, 3, 3]]) if is_edges else (p[[0, 0, 0]], p[1:])
        way = ToolPath.of(poses, moving, moving.mean(axis=0))
        tree = triangle_bvh(still[None], np.zeros(1, dtype=np.int64))
        found, closed = Pair(tree, Primitive(moving), way).least(0.0, np.inf)
        assert found is not None
        is_told, true = found.at_most <= MEETING, least(is_edges, p, np.array(shift))
        assert is_told or not is_hit
        assert true <= MEETING or not is_told
        assert is_told or closed - 1e-9 <= true <= found.at_most + 1e-9
        counts[is_hit, is_told] += 1
    assert counts[True, True] == sum(row["hit"] == "1" for row in rows) > 100
    assert counts[False, False] > 500
