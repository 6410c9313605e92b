"""The distance law through `Environment.touch`: strategies, and its default."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
import pytest

import hapticdb
from hapticdb import DistanceField, Environment
from hapticdb.errors import UsageError
from hapticdb.grid import CurveName
from hapticdb.kernels import force_law as kernels
from hapticdb.kernels.field.distance_law import DistanceFieldLaw
from hapticdb.kernels.field.packing import pack
from hapticdb.paper.calibration import calibrate
from hapticdb.paper.cost_model import CostModel, machine_name
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.query.law import LAWS, as_law, inset_of, law_named, reads_distances
from hapticdb.session.coupling import rendering_of
from hapticdb.store.base import Band, Keys, Rows
from kernels.test_distance_law import expected, grid_of, merged, objects, random_pose, random_shell
from naive_frame import NaiveTouch
from servers import Place
from voxels import blob, voxel_object, write_voxels

CURVES = [curve for curve in get_args(CurveName) if curve != "lexicographic"]


def make(url: str, curve: CurveName = "z") -> Environment:
    env = hapticdb.create(url, grid_of(curve), distances=True)
    for n, part in enumerate(objects(curve)):
        ids = np.zeros(len(part.keys), dtype=np.int64)
        rows = Rows(part.keys, ids, part.occupancy, Band(*pack(part.values)))
        env.store.add(voxel_object(env.grid, part.voxels, f"part {n}"), rows)
    env.store.save_costs(machine_name(), CostModel.of_equal_parts().figures())
    return env


@pytest.fixture
def env(tmp_path: Path) -> Environment:
    return make(str(tmp_path / "e.db"))


def assert_same(touch: hapticdb.Touch, wanted: NaiveTouch) -> None:
    assert touch.law == DistanceField()
    assert touch.hits.tolist() == wanted.hits
    assert touch.contacts.tolist() == wanted.contacts
    assert touch.contact_depths.tolist() == [wanted.contact_depths[n] for n in wanted.contacts]
    assert [o.id for o in touch.objects] == wanted.ids
    assert [tuple(pair) for pair in touch.pairs.tolist()] == wanted.pairs
    assert [tuple(pair) for pair in touch.contact_pairs.tolist()] == wanted.near
    assert [*touch.force, *touch.torque] == [*wanted.force, *wanted.torque]


def check_strategies(env: Environment, curve: CurveName) -> None:
    n_contacts = 0
    for seed in range(6):
        shell, pose, exclude = random_shell(seed, 200), random_pose(seed), [seed % 3 + 1]
        wanted = expected(merged(curve), shell, pose, exclude)
        n_contacts += len(wanted.contacts)
        for strategy in STRATEGIES:
            if strategy != "statement":
                assert_same(env.touch(shell, pose, strategy, exclude=exclude), wanted)
        poses = [pose, random_pose(seed + 1)]
        many = env.touch(shell, poses=poses, exclude=exclude, objects=True)
        assert [*many.forces[0], *many.torques[0]] == [*wanted.force, *wanted.torque]
        assert many.ids_at(0) == wanted.ids
    assert n_contacts > 0


@pytest.mark.parametrize("curve", CURVES)
def test_strategies_distance_law_equal_plain_python(tmp_path: Path, curve: CurveName) -> None:
    check_strategies(make(str(tmp_path / "e.db"), curve), curve)


@pytest.mark.parametrize("curve", CURVES)
def test_strategies_distance_law_on_server(place: Place, curve: CurveName) -> None:
    with make(place(), curve) as env:
        check_strategies(env, curve)


def test_cbgroup_distance_law_row_cost(env: Environment) -> None:
    """Rows cost nothing, but with their distances they are worth more than a descent."""
    shell, pose = random_shell(1, 200), random_pose(1)
    costs = CostModel(1.0, 1.0, 0.0, 1e-9, 1.0, distances=1e15)
    env.store.save_costs(machine_name(), costs.figures())
    with hapticdb.open(env.url) as reader:
        plane, distance = (reader.touch(shell, pose, "cbgroup", law=law) for law in LAWS.values())
    assert plane.query.ranges == 1
    assert distance.query.ranges > 1
    assert_same(distance, expected(merged(), shell, pose, []))


def test_calibrate_rows_with_distances(env: Environment) -> None:
    asked: list[bool] = []
    store, scan = env.store, env.store.scan

    def noted(lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        asked.append(distances)
        return scan(lows, highs, distances=distances)

    store.scan = noted  # type: ignore[method-assign]
    assert calibrate(store, repeats=1, budget=0.0).distances >= 1.0
    assert set(asked) == {False, True}


def test_touch_default_law_by_objects(env: Environment) -> None:
    shell, pose = random_shell(1, 40), random_pose(1)
    assert env.touch(shell, pose).law.name == "distance"  # type: ignore[attr-defined]
    assert env.touch(shell, pose, law="plane").law.name == "plane"  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match="tangent-plane law alone"):
        env.touch(shell, pose, "statement")
    with hapticdb.open(env.store.url) as other:
        write_voxels(other.store, blob(1, (20, 20, 20)), "without")
    assert env.touch(shell, pose).law.name == "plane"  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match=r"1 of 6 objects .*: give the law 'plane'"):
        env.touch(shell, pose, law="distance")
    with pytest.raises(UsageError, match=r"1 of 6 objects .*: give the law 'plane'"):
        env.touch(shell, poses=[pose], law="distance")
    with pytest.raises(UsageError, match="choose one of plane, distance"):
        env.touch(shell, pose, law="soft")  # type: ignore[call-overload]


def test_law_named_every_law() -> None:
    for name, law in LAWS.items():
        assert as_law(name) is law  # type: ignore[arg-type]
        assert law_named(name, 5.0) == replace(law, stiffness=5.0)


class Numbers(NamedTuple):
    """Numbers of a user's law on distances."""

    stiffness: float


class UsersLaw:
    """A user's law on distances."""

    stiffness, for_kernels = 5.0, Numbers(5.0)


def test_reads_distances_users_law() -> None:
    kernels.define(Numbers, kernels.LEAVES[DistanceFieldLaw])
    assert reads_distances(UsersLaw())
    assert inset_of(0.01, UsersLaw()) == inset_of(0.01, "distance") == 0.015
    assert rendering_of(None, UsersLaw()) == "direct"
