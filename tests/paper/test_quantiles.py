"""The quantile vector against counted rows; the cost model and its calibration."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import nnls

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.errors import UsageError
from hapticdb.paper.calibration import _non_negative, calibrate
from hapticdb.paper.cost_model import CostModel, machine_name
from hapticdb.paper.grouping import cbgroup
from hapticdb.paper.quantiles import MAX_RESOLUTION, QuantileVector
from hapticdb.store.base import Layout, SupportsCaches
from voxels import blob, floor_voxels, write_voxels

few = settings(max_examples=50, deadline=None)
GRID = Grid(0.005, (-0.16, -0.16, -0.16), 6)
KEYS = st.one_of(
    st.lists(st.integers(0, 30), min_size=1, max_size=200),
    st.lists(st.integers(0, 10**6), min_size=1, max_size=200),
    st.lists(st.integers(0, 2**62), min_size=1, max_size=50),
)


def vector_of(keys: list[int], resolution: int) -> QuantileVector:
    """Definition 2: bound i is the key of the row of rank ceil(i N / R), bound 0 the lowest."""
    rows = sorted(keys)
    ranks = [max(-(-i * len(rows) // resolution), 1) for i in range(resolution + 1)]
    return QuantileVector(np.array([rows[r - 1] for r in ranks], dtype=np.int64), len(rows))


@few
@given(keys=KEYS, resolution=st.integers(1, 250), unit=st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_rows_between_error_at_most_two_buckets(
    keys: list[int], resolution: int, unit: tuple[float, float]
) -> None:
    """The error is one bucket at each end, however many rows share a key."""
    quantiles = vector_of(keys, resolution)
    left, right = sorted(int(u * (max(keys) + 2)) for u in unit)
    counted = sum(left <= key <= right for key in keys)
    bound = 2 * quantiles.rows_per_bucket * (1 + 1e-12)
    assert abs(quantiles.rows_between(left, right) - counted) <= bound


@pytest.mark.parametrize("resolution", [0, -1, MAX_RESOLUTION + 1])
def test_quantiles_resolution_out_of_range(scene: Environment, resolution: int) -> None:
    with pytest.raises(UsageError, match=f"{resolution} quantiles"):
        scene.quantiles(resolution)


MODEL = CostModel(2.0, 3.0, 50.0, 0.5, 100.0)


def test_cbgroup_caution_closes_fewer_gaps() -> None:
    keys = np.arange(0, 4000, 40, dtype=np.int64)
    quantiles = QuantileVector(np.arange(0, 4001, 100, dtype=np.int64), 40 * 4)  # 1.56 rows a gap
    assert len(cbgroup(keys, keys, quantiles, replace(MODEL, caution=1.0)).lows) == 1
    assert len(cbgroup(keys, keys, quantiles, replace(MODEL, caution=3.0)).lows) == len(keys)


def make_scene(path: Path, layout: Layout = "brick") -> Environment:
    env = hapticdb.create(path, GRID, layout=layout)
    write_voxels(env.store, floor_voxels(GRID), "floor")
    write_voxels(env.store, blob(1, (32, 32, 36), 5), "blob")
    return env


@pytest.fixture(scope="module", params=["brick", "voxel"])
def scene(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Environment]:
    with make_scene(tmp_path_factory.mktemp("scene") / "e.db", request.param) as env:
        yield env


def test_calibrate_finite_non_negative(scene: Environment) -> None:
    model = calibrate(scene.store, repeats=1, budget=0.0)
    for name, value in model.figures().items():
        assert math.isfinite(value), name
        assert value >= 0, name
    size = scene.size()
    assert model.rows_per_block == size.rows / size.leaf_blocks
    assert set(model.spread) <= set(vars(model))


def test_calibrate_non_negative_fit_equals_scipy() -> None:
    rng = np.random.default_rng(4)
    n_zero = 0
    for _ in range(50):
        design = rng.normal(size=(rng.integers(3, 40), 3))
        wanted = design @ rng.normal(size=3) + rng.normal(size=len(design))
        figures, left = _non_negative(design, wanted)
        expected, expected_left = nnls(design, wanted)
        np.testing.assert_allclose(figures, expected, atol=1e-12)
        assert left == pytest.approx(expected_left)
        n_zero += int((figures == 0.0).any())
    assert n_zero > 10


def test_calibrate_cold_reads_disk(scene: Environment) -> None:
    """Each query is preceded by emptied caches: at least one block is read for it."""
    emptied: list[None] = []
    store = scene.store
    assert isinstance(store, SupportsCaches)
    drop = store.drop_caches
    store.drop_caches = lambda: emptied.append(drop())  # type: ignore[method-assign]
    model = calibrate(store, budget=0.0, cold=True)
    assert len(emptied) > 12
    assert all(math.isfinite(value) and value >= 0 for value in model.figures().values())


@pytest.mark.parametrize("bits", [1, 2, 3])
@pytest.mark.parametrize("layout", ["brick", "voxel"])
def test_calibrate_grid_smaller_than_tool(tmp_path: Path, layout: Layout, bits: int) -> None:
    """Otherwise the first touch by `cbgroup` would fail there."""
    env = hapticdb.create(tmp_path / "e.db", Grid(0.005, (0, 0, 0), bits), layout=layout)
    write_voxels(env.store, np.full((1, 3), env.grid.side // 2))
    figures = calibrate(env.store, repeats=1, budget=0.0).figures()
    assert all(math.isfinite(value) and value >= 0 for value in figures.values())


DEAR = CostModel(1e6, 1e6, 1e6, 1e6, 1.0)


def resting() -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, 3] = 0.002, 0.001, -0.004
    return pose


def opened_with(scene: Environment, model: CostModel) -> Environment:
    """The scene, opened anew, with figures as if calibrated on this machine."""
    scene.store.save_costs(machine_name(), model.figures())
    return hapticdb.open(scene.url, read_only=True)


def test_touch_cbgroup_ranges_by_costs(scene: Environment, sphere: PointShell) -> None:
    found = []
    for descent, row in ((1.0, 1e6), (1.0, 0.05), (1e6, 0.0)):
        model = replace(DEAR, descent=descent, block=0.0, row=row)
        with opened_with(scene, model) as env:
            found.append(env.touch(sphere, resting(), "cbgroup").query)
    ranges, rows = [q.ranges for q in found], [q.rows for q in found]
    assert ranges == sorted(ranges, reverse=True)
    assert rows == sorted(rows)
    assert ranges[0] > ranges[-1] == 1
    assert all(q.statements == 1 for q in found)
