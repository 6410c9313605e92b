"""Screw motions: profiles of threads against their closed form and against samples."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hapticdb.exact import profile
from hapticdb.exact.path import ToolPath
from hapticdb.exact.profile import gap_on_screw, screw_of
from hapticdb.kernels.triangles.surface_distance import nearest
from hapticdb.pointshell.shape import bvh_of

Floats = NDArray[np.float64]

PITCH, HIGH, ROOM = 2e-3, 1e-3, 2e-4
"""Metres: of a thread of triangles, and from the bolt's to the nut's along a radius."""


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer nodes and bisections: the bound is lower, and sooner there."""
    monkeypatch.setattr(profile, "NODES", 1024)
    monkeypatch.setattr(profile, "FINE", 1e-6)


def thread(low: float, high: float, room: float, hand: float, facets: int = 36) -> Floats:
    """Triangles (T, 3, 3) of a ridge around z, with two flanks of a half pitch each."""
    rows = np.linspace(low, high, 1 + round(4 * (high - low) / PITCH))
    turn, height = np.meshgrid(np.linspace(0.0, 1.0, facets + 1), rows)
    radius = 7e-3 + 2.0 * HIGH * np.abs((height / PITCH) % 1.0 - 0.5) + room
    angle, height = 2.0 * np.pi * hand * turn, height + PITCH * turn
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
    a, b, c, d = places[:-1, :-1], places[:-1, 1:], places[1:, :-1], places[1:, 1:]
    return np.concatenate([np.stack([a, b, d], -2), np.stack([a, d, c], -2)]).reshape(-1, 3, 3)


def screwed(tool: Floats, hand: float, turns: float, pitch: float = PITCH) -> Any:  # noqa: ANN401
    """Path of a screw motion along z, and the motion."""
    angles = np.linspace(0.0, 2.0 * np.pi * turns, 1 + round(12 * turns))
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", hand * angles[:, None]).as_matrix()
    poses[:, 2, 3] = pitch * angles / (2.0 * np.pi)
    path = ToolPath.of(poses, tool.reshape(-1, 3), np.zeros(3))
    return path, screw_of(path.motion, float(np.abs(tool).max()))


def least(thing: Floats, tool: Floats, path: ToolPath, n: int) -> float:
    """Least distance of surfaces at n samples of a path."""
    a, b = bvh_of(thing), bvh_of(tool)
    poses = path.at(np.linspace(0.0, path.length, n))
    return float(nearest(a, b, poses, np.full(n, np.inf)).at_most.min())


@pytest.mark.parametrize(("hand", "is_nut"), [(1.0, True), (-1.0, True), (1.0, False)])
def test_gap_on_screw_threads(hand: float, is_nut: bool) -> None:
    """Of flanks across at an angle: room * cos(flank), but for the sag of facets, at any turn."""
    bolt, nut = thread(0.0, 4 * PITCH, 0.0, hand), thread(PITCH, 2 * PITCH, ROOM, hand)
    thing, tool = (bolt, nut) if is_nut else (nut, bolt)
    path, screw = screwed(tool, hand, 2.0)
    gap, is_within, rest = gap_on_screw(thing, tool, screw, ROOM, lambda: None)
    assert is_within != is_nut
    assert not rest.any()
    radius, slope = 7e-3, 2.0 * HIGH / PITCH
    spread = slope**2 * (1.0 + (PITCH / (2.0 * np.pi * radius)) ** 2)
    closed_form = ROOM / np.sqrt(1.0 + spread)
    sag = (radius + HIGH) * (1.0 - np.cos(np.pi / 36))
    assert closed_form - sag - 5e-6 <= gap <= closed_form
    assert 0.96 * least(thing, tool, path, 30) <= gap <= least(thing, tool, path, 30)


def test_gap_on_screw_leaves_out_what_fills_the_thread() -> None:
    bolt, nut = thread(0.0, 4 * PITCH, 0.0, 1.0), thread(PITCH, 2 * PITCH, ROOM, 1.0)
    wall = np.array([[[6e-3, 0.0, PITCH], [9e-3, 0.0, PITCH], [9e-3, 0.0, 3 * PITCH]]])
    _, screw = screwed(nut, 1.0, 2.0)
    gap, _, rest = gap_on_screw(np.concatenate([bolt, wall]), nut, screw, ROOM, lambda: None)
    assert np.flatnonzero(rest).tolist() == [len(bolt)]
    assert gap > 0.5 * ROOM


def test_gap_on_screw_of_another_pitch_is_no_proof() -> None:
    bolt, nut = thread(0.0, 4 * PITCH, 0.0, 1.0), thread(PITCH, 2 * PITCH, ROOM, 1.0)
    for pitch, hand in ((1.5 * PITCH, 1.0), (PITCH, -1.0)):
        path, screw = screwed(nut, hand, 1.0, pitch)
        gap, _, rest = gap_on_screw(bolt, nut, screw, ROOM, lambda: None)
        assert least(bolt, nut, path, 30) < 1e-5
        assert gap == 0.0 or rest.any()


def test_gap_on_screw_bounds_samples_of_random_triangles() -> None:
    rng, tight = np.random.default_rng(4), 0
    for _ in range(30):
        angle, count = rng.uniform(0.0, 2.0 * np.pi, (2, 20)), 20
        radii = rng.uniform([[2e-3], [3.2e-3]], [[3e-3], [4.2e-3]], (2, count))
        places = np.stack([radii * np.cos(angle), radii * np.sin(angle)], axis=-1)
        places = np.concatenate([places, rng.uniform(-1e-3, 1e-3, (2, count, 1))], axis=-1)
        size = rng.choice([1e-4, 3e-4, 1e-3])
        thing, tool = places[:, :, None] + size * rng.normal(size=(2, count, 3, 3))
        thing, tool = (tool, thing) if rng.random() < 0.5 else (thing, tool)
        path, screw = screwed(tool, rng.choice([-1.0, 1.0]), 1.0, rng.choice([5e-4, PITCH]))
        gap, is_within, rest = gap_on_screw(thing, tool, screw, 3e-4, lambda: None)
        thing, tool = (thing, tool[~rest]) if is_within else (thing[~rest], tool)
        found = least(thing, tool, path, 30) if len(thing) and len(tool) else np.inf
        assert gap <= found
        tight += gap > 0.8 * min(found, 3e-4)
    assert tight > 0


def test_screw_of_uneven_motions_is_none() -> None:
    nut = thread(PITCH, 2 * PITCH, ROOM, 1.0)
    path, screw = screwed(nut, 1.0, 1.0)
    assert screw is not None
    motion = path.motion
    assert screw.slope == pytest.approx(PITCH / (2.0 * np.pi))
    for axis in (0, 2):
        centers = motion.centers.copy()
        centers[5, axis] += 1e-6
        assert screw_of(motion._replace(centers=centers), 1e-2) is None
    assert screw_of(motion._replace(turns=0.0 * motion.turns), 1e-2) is None
    assert screw_of(motion._replace(centers=0.0 * motion.centers), 1e-2) is None
