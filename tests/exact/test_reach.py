"""Reach of tools, against closed forms, exact distances of boxes, and bad arguments."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import hapticdb
from contact_scenes import MM, box, frame_of, imported, moved, placed, quad, ring, rod, shell_of
from hapticdb import Environment, Reached
from hapticdb.errors import ConnectionLostError, ObjectNotFoundError, UsageError
from hapticdb.poses import rotation_of
from hapticdb.store.base import Store
from moving_boxes import Boxes, apart

Floats = NDArray[np.float64]

LENGTH, HALF = 60.0, 5.0
"""Length of the tool from the axis, half of its width and height, millimetres."""
FARTHEST, WALL = float(np.hypot(LENGTH, HALF)), 40.0
TOOL = shell_of(box((LENGTH + HALF, 2 * HALF, 2 * HALF), ((LENGTH - HALF) / 2, 0, 0)))
BOLT = moved(trimesh.creation.cylinder(4.0, 20.0, sections=6))
PARTS = {
    "pin": rod(1.0, 100.0, 32, (-50, 0, 0)),
    "bolt": BOLT,
    "wide": ring(FARTHEST + 0.2, 80.0, 100.0, 128),
    "narrow": ring(FARTHEST - 0.2, 80.0, 100.0, 128),
    "sheet": quad((WALL, -99, -99), (WALL, 99, -99), (WALL, 99, 99), (WALL, -99, 99)),
    "lid": box((300, 300, 2), (0, 0, 18)),
    "shell": box((300, 300, 300)),
    "tilted": placed(BOLT, frame_of(3)),
    "floor": placed(box((300, 300, 10), (0, 0, -15)), frame_of(3)),
    "slab": box((10, 20, 30)),
    "cube": box((10, 10, 10)),
}


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    with imported(tmp_path_factory.mktemp("reach") / "parts.db", PARTS) as made:
        yield made


def reached(env: Environment, *obstacles: str, target: str = "bolt", **options: Any) -> Reached:  # noqa: ANN401
    return hapticdb.reach(env, [target], TOOL, where=obstacles, **options)


def angles_of(free: str, step: float) -> set[float]:
    """Angles of the runs of free placements."""
    found: set[float] = set()
    for run in filter(None, free.replace("all", f"0 to {360 - step}").split("; ")):
        first, last = (float(one) for one in (run.split(" to ") * 2)[:2])
        found |= {angle % 360 for angle in np.arange(first, last + 360 * (last < first) + 1, step)}
    return found


def test_reach_in_a_round_well(env: Environment) -> None:
    """Free where the tool's farthest place is nearer to the axis than the wall."""
    (wide,) = reached(env, "wide", step=45).targets
    assert (wide.verdict, wide.n_free, wide.n_angles, wide.free) == ("reachable", 8, 8, "all")
    assert wide.gap == pytest.approx(0.2 * MM, abs=0.03 * MM)
    (narrow,) = reached(env, "narrow", step=45).targets
    assert (narrow.verdict, narrow.n_free, narrow.free, narrow.gap) == (
        "not reachable",
        0,
        "",
        None,
    )
    assert [obj.name for obj in narrow.obstacles] == ["narrow"]


@pytest.mark.parametrize("turn", [0.0, 60.0, -30.0, 200.0, 300.0])
def test_reach_beside_a_thin_wall(env: Environment, turn: float) -> None:
    """A corner is beyond the wall at angles up to `widest` on both sides of it."""
    widest = np.degrees(np.arctan2(HALF, LENGTH) + np.arccos(WALL / FARTHEST))
    (found,) = reached(env, "sheet", axis=(0, 0, 2), turn=turn, step=5).targets
    low, high = widest - min(turn, 0.0), 360.0 - widest - max(turn, 0.0)
    assert angles_of(found.free, 5) == {a for a in np.arange(0.0, 360.0, 5) if low < a < high}
    assert found.n_free == len(angles_of(found.free, 5))


def test_reach_names_the_most_frequent_obstacle_first(env: Environment) -> None:
    (found,) = reached(env, "pin", "sheet", axis=(0, 0, 1)).targets
    assert [obj.name for obj in found.obstacles] == ["sheet", "pin"]
    (found,) = reached(env, "shell", step=90).targets  # nothing leaves a closed body
    assert (found.verdict, found.obstacles[0].name) == ("not reachable", "shell")


def test_reach_finds_the_axis_and_its_free_end(env: Environment) -> None:
    """A bolt stands on a floor, both turned at random."""
    frame = frame_of(3)
    (found,) = reached(env, "floor", target="tilted", step=30).targets
    assert found.n_free == 12
    assert found.pose[:3, 2] == pytest.approx(frame[:3, 2], abs=1e-9)
    assert found.pose[:3, 3] == pytest.approx(MM * (frame @ [0, 0, 10, 1])[:3], abs=1e-9)
    assert found.gap == pytest.approx(15 * MM, rel=0.01)


def test_reach_by_another_approach(env: Environment) -> None:
    """Under a lid the tool gets on from the side only."""
    (above,) = reached(env, "lid", axis=(0, 0, 1)).targets
    assert (above.n_free, above.obstacles[0].name) == (0, "lid")
    (aside,) = reached(env, "lid", axis=(0, 0, 1), approach="-x").targets
    assert aside.free == "all"
    assert aside.gap == pytest.approx(2 * MM, abs=0.02 * MM)
    about, offset = np.array([0.03, 0.01, 0.002]), -0.001
    for approach, z in (("-z", 1.0), ("z", -1.0)):
        options: dict[str, Any] = {"about": about, "offset": offset, "step": 360}
        (found,) = reached(env, "pin", axis=(0, 0, 1), approach=approach, **options).targets
        assert found.pose[:3, :3] == pytest.approx(np.diag([1.0, z, z]))
        assert found.pose[:3, :3] @ about + found.pose[:3, 3] == pytest.approx([0, 0, 0.009])


def least_distances(boxes: Boxes, angles: Floats, turn: float, lift: float) -> Floats:
    """Least distance (n,) of the tool from boxes at samples of its motions, millimetres."""
    heights = np.concatenate([np.linspace(lift, 0, 60), np.zeros(120), np.linspace(0, lift, 60)])
    turned = np.concatenate([np.zeros(60), np.linspace(0, turn, 120), np.full(60, turn)])
    found = []
    for angle in angles:
        poses = np.tile(np.eye(4), (len(turned), 1, 1))
        halves, quaternions = np.radians(angle + turned) / 2, np.zeros((len(turned), 4))
        quaternions[:, 0], quaternions[:, 3] = np.cos(halves), np.sin(halves)
        poses[:, :3, :3] = rotation_of(quaternions)
        poses[:, :3, 3] = poses[:, :3, 0] * (LENGTH - HALF) / 2
        poses[:, 2, 3] = 10.0 + heights
        found.append(apart(np.array([(LENGTH + HALF) / 2, HALF, HALF]), poses, boxes)[0].min())
    return np.array(found)


def test_reach_among_boxes_agrees_with_samples(tmp_path: Path) -> None:
    assert 0 < check_among_boxes(tmp_path, seed=0, count=6, step=40) < 9


def check_among_boxes(folder: Path, seed: int, count: int, step: int) -> int:
    """Compare the free placements among random boxes with samples; returns their number."""
    rng = np.random.default_rng(seed)
    turn = float(rng.uniform(-90.0, 90.0))
    poses = np.tile(np.eye(4), (count, 1, 1))
    turns = rng.normal(size=(count, 4))
    poses[:, :3, :3] = rotation_of(turns / np.linalg.norm(turns, axis=1, keepdims=True))
    around = rng.uniform(0.0, 2.0 * np.pi, count)
    poses[:, 0, 3], poses[:, 1, 3] = 45 * np.cos(around), 45 * np.sin(around)
    poses[:, 2, 3] = rng.uniform(-10, 40, count)
    boxes = Boxes(poses, rng.uniform(2.0, 8.0, (count, 3)))
    parts = {f"box{n}": placed(box(tuple(2 * half)), pose)
             for n, (pose, half) in enumerate(zip(*boxes, strict=True))}  # fmt: skip
    with imported(folder / "boxes.db", {"bolt": BOLT, **parts}) as env:
        options: dict[str, Any] = {"step": step, "turn": turn, "lift": 30 * MM}
        (found,) = hapticdb.reach(env, ["bolt"], TOOL, axis=(0, 0, 1), **options).targets
    angles = np.arange(0.0, 360.0, step)
    least, free = least_distances(boxes, angles, turn, 30.0), angles_of(found.free, step)
    for angle, distance in zip(angles.tolist(), least.tolist(), strict=True):
        assert abs(distance) < 0.2 or (angle in free) == (distance > 0.0), (angle, distance)
    if found.gap is not None:
        assert found.gap / MM == pytest.approx(min(least.max(), 20.0), abs=0.2)
    return found.n_free


def test_reach_time_limit_undecided(env: Environment) -> None:
    found = reached(env, "sheet", "wide", seconds=1e-9)
    assert [one.verdict for one in found.targets] == ["not decided"]
    assert found.columns()["verdict"] == ["not decided"]


def test_reach_checks_all_axes_first(env: Environment) -> None:
    told: list[tuple[int, int]] = []
    with pytest.raises(UsageError, match=r"\(slab\) has no single axis"):
        hapticdb.reach(
            env, ["bolt", "slab"], TOOL, where=["sheet"],
            progress=lambda *now: told.append(now),
        )  # fmt: skip
    assert told == []


def test_reach_lost_connection_once_more(env: Environment, monkeypatch: pytest.MonkeyPatch) -> None:
    expected, read = reached(env, "sheet"), type(env.store).surfaces
    lost: list[list[str]] = []

    def lose_once(store: Store, digests: list[str]) -> dict[str, bytes]:
        if not lost:
            lost.append(digests)
            raise ConnectionLostError("the server went away: run the same again")
        return read(store, digests)

    monkeypatch.setattr(type(env.store), "surfaces", lose_once)
    found = reached(env, "sheet")
    assert lost
    assert [one.free for one in found.targets] == [one.free for one in expected.targets]


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"target": "slab"}, UsageError, "(slab) has no single axis of symmetry: give --axis"),
        ({"target": "cube"}, UsageError, "(cube) has no single axis of symmetry"),
        ({"target": "nut"}, ObjectNotFoundError, "nut"),
        ({"axis": (0, 0, 0)}, UsageError, "give a direction"),
        ({"axis": (0, 1)}, UsageError, "give a direction"),
        ({"lift": 0.0}, UsageError, "lift 0.0 m"),
        ({"offset": np.nan}, UsageError, "offset nan m"),
        ({"turn": 1e9}, UsageError, "turn 1000000000.0 degrees"),
        ({"step": 0.0}, UsageError, "step of 0.0 degrees"),
        ({"approach": "up"}, UsageError, "approach 'up'"),
    ],
)
def test_reach_bad_arguments(
    env: Environment, options: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=re.escape(words)):
        reached(env, "pin", **options)
