"""`where` and `exclude` say what is felt: by every strategy, and as others write."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import hapticdb
from hapticdb import Environment, Grid
from hapticdb.errors import ObjectNotFoundError
from hapticdb.grid import CurveName
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.paper.cost_model import CostModel, machine_name
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.resident.table import LEAST_BUDGET
from hapticdb.store.base import Layout, Store
from naive import Voxel
from query.test_frame import (  # noqa: F401 - a fixture among them
    BITS,
    ORIGIN,
    SIZE,
    assert_same,
    expected,
    plain,
    random_pose,
    random_shell,
    scene_voxels,
)
from servers import ENGINES, named, url_on
from voxels import voxel_object

OBJECTS: tuple[tuple[str, dict[str, object]], ...] = (
    ("body/door", {"material": "steel", "mass": 12.5}),
    ("body/door/handle", {"material": "brass", "tags": ["left", "front"]}),
    ("body/hood", {"material": "steel", "made": {"by": "press", "year": 1930}}),
    ("far/material=wood", {"material": "steel", "mass": 1e3}),
    ("wheel", {"material": "rubber", "is_spare": True}),
)
"""Name and attributes of the scene's objects, whose ids count from 1."""
CHOSEN: dict[int | str, set[int]] = {
    1: {1},
    "2,3": {2, 3},
    "body": {1, 2, 3},
    "handle": {2},
    "material=steel": {1, 3, 4},
    "material=*e*": {1, 3, 4, 5},
    "material=wood": {4},  # a name goes before an attribute
    "made.by=press": {3},
    "made.year=1930.0": {3},
    "tags=front": {2},
    "mass=1000": {4},
    "mass=*": {1, 4},
    "is_spare=true": {5},
    "wheel,mass=12.5": {1, 5},
}
"""What each word chooses."""
WORDS = st.lists(st.sampled_from(list(CHOSEN)), max_size=3)


def ids_of(words: list[int | str]) -> set[int]:
    return {i for word in words for i in CHOSEN[word]}


def excluded(where: list[int | str], exclude: list[int | str]) -> list[int]:
    everything = {1, 2, 3, 4, 5}
    felt = (ids_of(where) if where else everything) - ids_of(exclude)
    return sorted(everything - felt)


def add(store: Store, number: int, name: str, attributes: dict[str, object]) -> int:
    ijk = scene_voxels()[number]
    record = replace(voxel_object(store.grid, ijk, name), attributes=attributes)
    return store.add(record, rows_of_voxels(ijk, store.grid, store.layout))


def make_scene(url: Path | str, layout: Layout, curve: CurveName) -> Environment:
    env = hapticdb.create(url, Grid(SIZE, ORIGIN, BITS, curve), layout=layout, distances=False)
    for n, (name, attributes) in enumerate(OBJECTS):
        assert add(env.store, n, name, attributes) == n + 1
    env.store.save_costs(machine_name(), CostModel.of_equal_parts().figures())
    return env


@pytest.fixture(scope="module", params=[("brick", "z"), ("voxel", "hilbert")], ids="-".join)
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
        url_on(request.param, tmp_path_factory.mktemp("filter")) as url,
        make_scene(url, *kind) as made,
    ):
        yield made


@settings(
    max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_points=st.sampled_from([1, 9, 300]),
    where=WORDS,
    exclude=WORDS,
)
def test_touch_filter_equals_plain_set(
    env: Environment,
    plain: dict[Voxel, set[int]],
    seed: int,
    n_points: int,
    where: list[int | str],
    exclude: list[int | str],
) -> None:
    shell, pose = random_shell(seed, n_points), random_pose(seed)
    wanted = expected(plain, shell, pose, excluded(where, exclude))
    for strategy in STRATEGIES:
        touch = env.touch(shell, pose, strategy, where=where, exclude=exclude)
        assert_same(touch, wanted)
    words: dict[str, Any] = {"where": where, "exclude": exclude}
    with env.batch_tool(shell, budget_bytes=LEAST_BUDGET, jobs=1, **words) as batch_tool:
        many = batch_tool.touch([pose, pose])
    assert many.forces.tolist() == [list(wanted.force)] * 2
    assert many.torques.tolist() == [list(wanted.torque)] * 2
    assert many.hits.tolist() == [len(wanted.hits)] * 2
    found = {obj.id for obj in env.select(where, exclude)}
    assert found == {1, 2, 3, 4, 5} - set(excluded(where, exclude))


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("nobody", "no object 'nobody'"),
        ("material=glass", "material is 'brass', 'rubber', 'steel'"),
        ("colour=red", "attributes are 'is_spare', 'made', 'mass', 'material', 'tags'"),
        ("mass=12.6", "mass is '1000', '12.5'"),
        ("=steel", "no object '=steel'"),
    ],
)
def test_touch_filter_unknown_word(env: Environment, word: int | str, said: str) -> None:
    shell, far = random_shell(1, 3), np.eye(4)
    far[:3, 3] = 1e6  # outside the grid, where no statement is sent
    for pose in (random_pose(1), far):
        for name in ("where", "exclude"):
            words: dict[str, Any] = {name: [1, word]}
            with pytest.raises(ObjectNotFoundError, match=f"^{name}: ") as told:
                env.touch(shell, pose, **words)
            assert said in str(told.value)
            assert "\n" not in str(told.value)


def test_touch_filter_follows_commits(tmp_path: Path) -> None:
    """A new object is felt if the words choose it, and so is one whose attributes change."""
    shell, pose = random_shell(4, 300), np.eye(4)
    pose[:3, 3] = np.array(ORIGIN) + SIZE * np.array((22, 21, 22))
    with make_scene(tmp_path / "e.db", "brick", "z") as env, hapticdb.open(env.url) as writer:
        for i in (4, 5):
            writer.remove(i)

        def felt(words: list[int | str]) -> set[int]:
            touched = {obj.id for obj in env.touch(shell, pose, where=words).objects}
            many = env.touch(shell, poses=[pose], where=words, objects=True)
            assert {obj.id for obj in many.objects} == touched
            return touched

        steel: list[int | str] = ["material=steel"]
        assert felt(steel) == {1, 3}
        assert felt([1]) == {1}
        new = add(writer.store, 1, "strut", {"material": "steel"})
        wood = add(writer.store, 1, "plank", {"material": "wood"})
        assert felt(steel) == {1, 3, new}
        assert felt([1]) == {1}
        assert felt(["material=wood"]) == {wood}
        old = writer.object(1)
        rows = rows_of_voxels(writer.voxels(1), writer.grid, writer.layout)
        changed = replace(old, attributes={"material": "wood"})
        writer.store.replace(changed, rows)
        assert felt(steel) == {3, new}
        assert felt(["material=wood"]) == {1, wood}
        writer.remove(wood)
        writer.remove(1)
        with pytest.raises(ObjectNotFoundError, match="where: no object 'material=wood'"):
            felt(["material=wood"])
