"""The strategy `auto`: a lookup of all keys, or a scan of ranges where many keys share few."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.paper.cost_model import CostModel, machine_name
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.store.base import Layout, Store
from voxels import floor_voxels, write_voxels

ONE_RANGE = CostModel(1.0, 1e9, 0.0, 1.0, 100.0)
NO_GAP_CLOSED = CostModel(1.0, 0.0, 0.0, 1e9, 100.0)
BITS: dict[Layout, int] = {"voxel": 6, "brick": 8}


def make_scene(url: Path | str, layout: Layout = "brick") -> Environment:
    """A floor across the grid, its top in the middle."""
    bits = BITS[layout]
    env = hapticdb.create(url, Grid(0.005, (0, 0, 0), bits), layout=layout)
    write_voxels(env.store, floor_voxels(env.grid, width=env.grid.side), "floor")
    return env


def cloud(env: Environment, n_points: int) -> PointShell:
    """Points drawn from a slab as wide as the grid, about the tool's origin."""
    rng = np.random.default_rng(n_points)
    normals = rng.normal(size=(n_points, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = rng.uniform(-0.5, 0.5, (n_points, 3)) * env.grid.edge * (1, 1, 0.25)
    return PointShell(points=points, normals=normals, center=np.zeros(3))


def middle(env: Environment) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, 3] = env.grid.edge / 2
    return pose


def keep_figures(store: Store, model: CostModel) -> None:
    """Keep figures as if calibrated on this machine."""
    store.save_costs(machine_name(), model.figures())


@pytest.mark.parametrize("layout", BITS)
@pytest.mark.parametrize(
    ("model", "n_points", "used"),
    [(ONE_RANGE, 3000, "cbgroup"), (NO_GAP_CLOSED, 3000, "array"), (ONE_RANGE, 500, "array")],
)
def test_touch_auto_equals_named_strategy(
    tmp_path: Path, layout: Layout, model: CostModel, n_points: int, used: str
) -> None:
    with make_scene(tmp_path / "e.db", layout) as env:
        keep_figures(env.store, model)
        shell, pose = cloud(env, n_points), middle(env)
        auto = env.touch(shell, pose)
        assert auto.query.strategy == used
        assert len(auto.hits) > 10
        for strategy in STRATEGIES:
            touch = env.touch(shell, pose, strategy)
            if strategy == "auto" and layout == "brick":  # all bricks are in memory
                assert touch.query[:4] == ("array", 0, 0, 0)
            elif strategy in {"auto", used}:
                assert touch.query[:4] == auto.query[:4]  # strategy, statements, ranges, rows
            assert touch.force.tobytes() == auto.force.tobytes()
            assert touch.torque.tobytes() == auto.torque.tobytes()
            assert touch.hits.tolist() == auto.hits.tolist()
            assert touch.pairs.tolist() == auto.pairs.tolist()


def test_touch_auto_independent_of_history(tmp_path: Path) -> None:
    with make_scene(tmp_path / "e.db", "voxel") as env:
        keep_figures(env.store, ONE_RANGE)
        far = middle(env)
        far[:3, 3] += 1e3
        frames = [
            (cloud(env, n_points), pose) for n_points in (300, 3000) for pose in (middle(env), far)
        ]
        asked = [[env.touch(*frame).query[:4] for frame in frames] for _ in range(5)]
        assert all(queries == asked[0] for queries in asked)
        assert [query[0] for query in asked[0]] == ["array", "array", "cbgroup", "array"]


@pytest.mark.parametrize("change", [{"statemenp": 1.0}, {"rows_per_block": 0.0}])
def test_touch_damaged_costs(tmp_path: Path, change: dict[str, float]) -> None:
    with make_scene(tmp_path / "e.db") as env:
        env.store.save_costs(machine_name(), ONE_RANGE.figures() | change)
        assert CostModel.stored(env.store, machine_name()) is None
        assert env.touch(cloud(env, 9), middle(env), "cbgroup").query.ranges
