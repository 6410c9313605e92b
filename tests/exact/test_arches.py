"""Arches of wedges in face contact: every neighbouring pair touches, and none overlaps."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from contact_scenes import MM, Floats, frame_of, imported, judged, placed
from hapticdb import find_clashes
from hapticdb.exact.clash import classify_pair
from hapticdb.pointshell.shape import CollisionShape

SIDES = ((0, 1, 2, 3), (7, 6, 5, 4), (4, 5, 1, 0), (5, 6, 2, 1), (6, 7, 3, 2), (7, 4, 0, 3))
"""Corners of a wedge's sides, outward."""


def arch(n: int, inner: float = 4000.0, outer: float = 4300.0, deep: float = 500.0) -> list[Floats]:
    """A half circle of n wedges, millimetres; neighbours share the corners of a face."""
    angles = np.linspace(0.0, np.pi, n + 1)
    rays = np.stack([np.cos(angles), np.zeros(n + 1), np.sin(angles)], axis=1)
    rings = [inner * rays, outer * rays]
    wedges = []
    for i in range(n):
        front = np.array([rings[0][i], rings[1][i], rings[1][i + 1], rings[0][i + 1]])
        corners = np.concatenate([front, front + np.array([0.0, deep, 0.0])])
        wedges.append(corners[[side[k] for side in SIDES for k in (0, 1, 2, 0, 2, 3)]])
    return [wedge.reshape(-1, 3, 3) for wedge in wedges]


@pytest.mark.parametrize(
    ("n", "seed"), [*((n, seed) for n in (25, 100) for seed in range(3)), (301, 1), (951, 2)]
)
def test_classify_pair_arch_neighbours_touch(n: int, seed: int) -> None:
    """In any frame, where shared corners stay equal; the gap of the others is the inner chord."""
    wedges = [placed(wedge, frame_of(seed)) for wedge in arch(n)]
    chord = 2.0 * 4000.0 * np.sin(0.5 * np.pi / n)
    for one, other in pairwise(wedges):
        assert judged(one, other).kind == "touching"
    for one, other in zip(wedges, wedges[2:], strict=False):
        found = judged(one, other)
        assert found.kind in {"apart", "far"}
        assert found.kind == "far" or found.at_least == pytest.approx(chord, rel=0.1)


@pytest.mark.parametrize("n", [25, 951])
def test_classify_pair_arch_of_placed_wedge(n: int) -> None:
    """Its corners are turned, so that shared ones differ by rounding."""
    wedge, angle = CollisionShape(MM * arch(n)[0]), np.pi / n
    for i in range(n - 1):
        before, after = (np.eye(4), np.eye(4))
        for pose, turn in ((before, i * angle), (after, (i + 1) * angle)):
            cos, sin = np.cos(turn), np.sin(turn)
            pose[:3, :3] = [[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]]
        found = classify_pair(wedge, wedge, np.linalg.inv(before) @ after, MM, 0.05 * MM)
        assert found.kind == "touching"


def test_find_clashes_arch_300_touching_pairs(tmp_path: Path) -> None:
    surfaces = {f"wedge {i}": wedge for i, wedge in enumerate(arch(301))}
    with imported(tmp_path / "arch.db", surfaces) as env:
        found = find_clashes(env)
        assert {kind: n for kind, n in found.counts().items() if n} == {"touching": 300}
        assert {abs(one.a - one.b) for one in found.pairs} == {1}
