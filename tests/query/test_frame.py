"""Case 9: every strategy, layout, curve and engine finds what a plain set finds, bit for bit."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from children import until
from hapticdb import Environment, Grid, PointShell
from hapticdb.grid import CurveName
from hapticdb.paper.cost_model import CostModel, machine_name
from hapticdb.paper.strategies import STRATEGIES, Strategy
from hapticdb.store.base import Layout
from naive_frame import NaiveTouch, touch_of_shell
from servers import ENGINES, Place, named, url_on
from session import worlds
from voxels import EVERYWHERE, KINDS, blob, write_voxels

ORIGIN = (-0.31, 0.17, -0.05)
SIZE = 0.013
BITS = 6
BLOBS = [((20, 20, 20), 1), ((26, 22, 20), 2), ((20, 21, 27), 3), ((60, 60, 60), 4), ((2, 3, 2), 5)]


def scene_voxels() -> list[NDArray[np.int64]]:
    """Blobs that share voxels, and two that the grid's border cuts."""
    voxels = [blob(seed, center) for center, seed in BLOBS]
    return [v[((v >= 0) & (v < 1 << BITS)).all(axis=1)] for v in voxels]


@pytest.fixture(scope="module")
def plain() -> dict[tuple[int, int, int], set[int]]:
    found: dict[tuple[int, int, int], set[int]] = {}
    for n, voxels in enumerate(scene_voxels()):
        for i, j, k in voxels.tolist():
            found.setdefault((i, j, k), set()).add(n + 1)
    return found


@pytest.fixture(scope="module", params=KINDS, ids="-".join)
def kind(request: pytest.FixtureRequest) -> tuple[Layout, CurveName]:
    layout, curve = request.param
    return layout, curve


@pytest.fixture(scope="module", params=ENGINES, ids=named)
def env(
    request: pytest.FixtureRequest,
    kind: tuple[Layout, CurveName],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Environment]:
    with (
        url_on(request.param, tmp_path_factory.mktemp("scene")) as url,
        make_scene(url, *kind) as made,
    ):
        yield made


def make_scene(url: Path | str, layout: Layout, curve: CurveName) -> Environment:
    env = hapticdb.create(url, Grid(SIZE, ORIGIN, BITS, curve), layout=layout)
    for n, voxels in enumerate(scene_voxels()):
        write_voxels(env.store, voxels, f"blob {n}")
    env.store.save_costs(machine_name(), CostModel.of_equal_parts().figures())
    return env


def random_shell(seed: int, n_points: int) -> PointShell:
    """A shell whose second half of points share keys with the first."""
    shell = worlds.random_shell(seed, n_points, 12.0, SIZE)
    points = shell.points.copy()
    points[n_points // 2 :] = points[: n_points - n_points // 2]
    return replace(shell, points=points)


def random_pose(seed: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    pose = worlds.turned(rng, np.zeros(3))
    center = np.array(BLOBS[rng.integers(len(BLOBS))][0]) + rng.normal(size=3) * 4
    pose[:3, 3] = np.array(ORIGIN) + SIZE * center
    return pose


def expected(
    plain: dict[tuple[int, int, int], set[int]],
    shell: PointShell,
    pose: NDArray[np.float64],
    exclude: list[int],
) -> NaiveTouch:
    return touch_of_shell(plain, Grid(SIZE, ORIGIN, BITS), shell, pose, exclude)


def assert_same(touch: hapticdb.Touch, wanted: NaiveTouch) -> None:
    assert touch.hits.tolist() == wanted.hits
    assert touch.contacts.tolist() == wanted.contacts
    assert touch.depths.tolist() == wanted.depths
    assert [o.id for o in touch.objects] == wanted.ids
    assert [tuple(pair) for pair in touch.pairs.tolist()] == wanted.pairs
    assert touch.force.tobytes() == np.array(wanted.force).tobytes()
    assert touch.torque.tobytes() == np.array(wanted.torque).tobytes()


@settings(
    max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_points=st.sampled_from([1, 2, 9, 40, 300]),
    exclude=st.lists(st.integers(1, 5), max_size=3),
    maxgap=st.sampled_from([0, 1, 7, 500, 10**5, 10**18]),
)
def test_strategies_equal_plain_set(
    env: Environment,
    plain: dict[tuple[int, int, int], set[int]],
    seed: int,
    n_points: int,
    exclude: list[int],
    maxgap: int,
) -> None:
    shell, pose = random_shell(seed, n_points), random_pose(seed)
    wanted = expected(plain, shell, pose, exclude)
    for strategy in STRATEGIES:
        touch = env.touch(shell, pose, strategy, exclude=exclude, maxgap=maxgap)
        assert_same(touch, wanted)


def test_maxgap_zero_equals_points(env: Environment) -> None:
    shell, pose = random_shell(3, 300), random_pose(3)
    points = env.touch(shell, pose, "points").query
    ranges = env.touch(shell, pose, "maxgap", maxgap=0).query
    if env.layout == "voxel":
        assert ranges.ranges == points.ranges == points.statements
    assert ranges.rows == points.rows
    assert ranges.statements == 1


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_touch_points_outside_grid_no_wrap(env: Environment, strategy: Strategy) -> None:
    shell = random_shell(1, 40)
    for axis in range(3):
        for side in (-1.0, 1.0):
            pose = random_pose(1)
            pose[axis, 3] += side * env.grid.edge  # the same place, were keys to wrap
            touch = env.touch(shell, pose, strategy)
            inside = env.grid.contains(
                env.grid.voxels_of(shell.points @ pose[:3, :3].T + pose[:3, 3])
            )
            assert set(touch.hits.tolist()) <= set(np.flatnonzero(inside).tolist())
    pose = np.eye(4)
    pose[:3, 3] = 1e300
    touch = env.touch(shell, pose, strategy)
    assert not touch.hits.size
    assert not touch.force.any()


@pytest.mark.parametrize(
    "pose",
    [
        np.eye(3),
        np.full((4, 4), np.nan),
        np.diag([2.0, 1, 1, 1]),
        np.diag([-1.0, 1, 1, 1]),
        np.diag([1.0, 1, 1, 2]),
    ],
)
def test_touch_non_rigid_pose(tmp_path: Path, pose: NDArray[Any]) -> None:
    env = make_scene(tmp_path / "e.db", "brick", "z")
    with pytest.raises(hapticdb.errors.UsageError, match="pose"):
        env.touch(random_shell(1, 3), pose)


def test_touch_unknown_strategy(tmp_path: Path) -> None:
    env = make_scene(tmp_path / "e.db", "brick", "z")
    with pytest.raises(hapticdb.errors.UsageError, match="choose one of auto"):
        env.touch(random_shell(1, 3), np.eye(4), "fastest")  # type: ignore[call-overload]


@pytest.mark.parametrize("is_file", [True, False])
def test_touch_reads_only_edited_objects(
    tmp_path: Path, place: Place, is_file: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make_scene(tmp_path / "e.db" if is_file else place(), "brick", "z")
    shell, pose = random_shell(5, 300), random_pose(5)
    env.touch(shell, pose)
    known, listing = env._query.known, env.store.objects
    monkeypatch.setattr(env.store, "objects", None)

    def touch_until(claim: Callable[[], bool]) -> None:
        """A server's notification takes a moment."""
        env.touch(shell, pose)
        assert claim() or not is_file
        until(lambda: env.touch(shell, pose) and claim())

    with hapticdb.open(env.url) as other:
        rows = other.store.rows_of(2, *EVERYWHERE)
        old = other.remove(2)
        write_voxels(other.store, scene_voxels()[1], "new")
        touch_until(lambda: 2 not in known.by_id and 6 in known.by_id)
        assert known.by_id[6].name == "new"
        other.store.replace(
            replace(other.object(1), attributes={"a": 1}, revision=0),
            other.store.rows_of(1, *EVERYWHERE),
        )  # fmt: skip
        other.store.add(old, rows)
        touch_until(lambda: 2 in known.by_id)
        assert [(o.id, o.name, o.revision) for o in known.by_id.values()] == [
            (o.id, o.name, o.revision) for o in listing()
        ]
        assert known.by_id[1].attributes == {"a": 1}
        monkeypatch.undo()
        monkeypatch.setattr(known, "_last", replace(list(env.store.changes())[-1], id=5))
        other.remove(4)
        touch_until(lambda: 4 not in known.by_id)  # the log is another one: all are listed
        assert list(known.by_id) == [1, 2, 3, 5, 6]
    env.close()


def test_touch_empty_environment(tmp_path: Path) -> None:
    env = hapticdb.create(tmp_path / "e.db", Grid(SIZE, ORIGIN, BITS))
    for strategy in STRATEGIES:
        touch = env.touch(random_shell(1, 300), random_pose(1), strategy)
        assert not touch.force.any()
        assert not touch.torque.any()


def test_touch_contact_positions_normals_depths(tmp_path: Path) -> None:
    env = make_scene(tmp_path / "e.db", "brick", "z")
    shell, pose = random_shell(5, 300), random_pose(5)
    touch = env.touch(shell, pose)
    assert len(touch.contacts) > 10
    at = shell.points[touch.contacts] @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(touch.contact_points, at, atol=1e-12)
    turned = shell.normals[touch.contacts] @ pose[:3, :3].T
    np.testing.assert_allclose(touch.contact_normals, turned, atol=1e-12)
    assert (touch.contact_depths > 0).all()
    is_included = np.isin(touch.hits, touch.contacts)
    assert touch.contact_depths.tolist() == touch.depths[is_included].tolist()
