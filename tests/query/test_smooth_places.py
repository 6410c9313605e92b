"""The smooth law on scenes of triangles: every strategy, engine and curve feels the same."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticdb import DistanceField, Environment, PointShell
from hapticdb.query.frame import STRATEGIES
from servers import Place
from smooth_scenes import imported

SMOOTH = [strategy for strategy in STRATEGIES if strategy != "statement"]


def poses() -> NDArray[np.float64]:
    """Poses (24, 4, 4) about the slab and the post, turned at random, the last beside the grid."""
    random = np.random.default_rng(5)
    found = np.tile(np.eye(4), (24, 1, 1))
    found[:, :3, :3] = np.linalg.qr(random.normal(size=(24, 3, 3)))[0]
    found[:, :3, 0] *= np.linalg.det(found[:, :3, :3])[:, None]
    found[:, :3, 3] = random.uniform(-0.09, 0.09, (24, 3)) * (1.0, 1.0, 0.6) + (0.0, 0.0, 0.03)
    found[-1, :3, 3] = 9.0
    return found


def check_strategies(env: Environment, shell: PointShell) -> list[list[float]]:
    """Check all strategies and many poses at once against `array`; returns the wrenches."""
    path = poses()
    ones = [env.touch(shell, pose, "array") for pose in path]
    wrenches = [[*one.force, *one.torque] for one in ones]
    assert all(one.law == DistanceField() for one in ones)
    assert {obj.id for one in ones for obj in one.objects} == {1, 2, 3}
    assert sum(len(one.contacts) > len(one.hits) for one in ones) > 0
    for strategy in SMOOTH:
        for pose, one in zip(path, ones, strict=True):
            other = env.touch(shell, pose, strategy)
            assert [*other.force, *other.torque] == [*one.force, *one.torque]
            assert other.hits.tolist() == one.hits.tolist()
            assert other.contacts.tolist() == one.contacts.tolist()
            assert other.contact_depths.tolist() == one.contact_depths.tolist()
            assert other.contact_pairs.tolist() == one.contact_pairs.tolist()
            assert [obj.id for obj in other.objects] == [obj.id for obj in one.objects]
    many = env.touch(shell, poses=path, objects=True)
    assert np.column_stack([many.forces, many.torques]).tolist() == wrenches
    assert many.hits.tolist() == [len(one.hits) for one in ones]
    assert many.n_contacts.tolist() == [len(one.contacts) for one in ones]
    assert many.deepest.tolist() == [one.contact_depths.max(initial=0.0) for one in ones]
    for n, one in enumerate(ones):
        assert many.ids_at(n) == [obj.id for obj in one.objects]
    return wrenches


def test_both_engines_and_curves_feel_the_same(tmp_path: Path, place: Place) -> None:
    shell = PointShell.sphere(0.04, 300)
    with imported(tmp_path / "z.db") as env:
        wanted = check_strategies(env, shell)
    with imported(tmp_path / "h.db", "hilbert") as env:
        assert check_strategies(env, shell) == wanted
    for curve in ("z", "hilbert"):
        with imported(place(), curve) as env:
            assert check_strategies(env, shell) == wanted
