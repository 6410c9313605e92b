"""Many poses in one call: the same as single touches, bit for bit, all at one revision."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

import hapticdb
from hapticdb import Environment, Grid, ObjectNotFoundError, PointShell, TangentPlane, UsageError
from hapticdb.grid import CurveName
from hapticdb.query.frame import STRATEGIES, HapticQuery, Strategy
from hapticdb.store.base import Layout
from hapticdb.testing import KINDS, floor_voxels, write_voxels
from servers import Place


def filled(url: str | Path, layout: Layout = "brick", curve: CurveName = "z") -> Environment:
    """Two objects that share voxels, in a grid of 64 voxels of 5 mm."""
    grid = Grid(0.005, (-0.16, -0.16, -0.16), 6, curve)
    env = hapticdb.create(url, grid, layout=layout)
    floor = floor_voxels(grid, width=40)
    write_voxels(env.store, floor, "floor")
    write_voxels(env.store, np.concatenate([floor[::3], floor[:50] + np.array([0, 0, 5])]), "rug")
    return env


def scattered(n: int) -> NDArray[np.float64]:
    """Poses (n, 4, 4) about the floor, turned at random, the last beside the grid."""
    random = np.random.default_rng(5)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(random.normal(size=(n, 3, 3)))[0]
    poses[:, :3, 0] *= np.linalg.det(poses[:, :3, :3])[:, None]
    poses[:, :3, 3] = random.uniform(-0.1, 0.1, (n, 3)) * (1.0, 1.0, 0.3)
    poses[-1, :3, 3] = 9.0
    return poses


def check_same(
    env: Environment,
    shell: PointShell,
    poses: NDArray[np.float64],
    strategy: Strategy,
    **how: Any,  # noqa: ANN401 - handed on
) -> None:
    many = env.touch_many(shell, poses, strategy, contacts=True, **how)
    ones = [env.touch(shell, pose, **how) for pose in poses]
    assert many.forces.tobytes() == np.array([one.force for one in ones]).tobytes()
    assert many.torques.tobytes() == np.array([one.torque for one in ones]).tobytes()
    assert many.hits.tolist() == [len(one.hits) for one in ones]
    assert many.n_contacts.tolist() == [len(one.contacts) for one in ones]
    assert many.deepest.tolist() == [float(one.depths.max(initial=0.0)) for one in ones]
    assert many.ids == [[obj.id for obj in one.objects] for one in ones]
    assert {obj.id for obj in many.objects} == {i for ids in many.ids for i in ids}
    assert many.contacts is not None
    listed = [(n, point, depth) for n, one in enumerate(ones) for point, depth in contacts_of(one)]
    assert many.contacts.tolist() == listed
    assert listed
    assert 0 < np.count_nonzero(many.hits) < len(poses) == len(many)


def contacts_of(touch: hapticdb.Touch) -> list[tuple[int, float]]:
    is_contact = touch.depths > 0
    return list(
        zip(touch.hits[is_contact].tolist(), touch.depths[is_contact].tolist(), strict=True)
    )


@pytest.mark.parametrize(("layout", "curve"), KINDS)
def test_many_poses_give_what_each_gives_by_itself(
    tmp_path: Path, sphere: PointShell, layout: Layout, curve: CurveName
) -> None:
    with filled(tmp_path / "e.db", layout, curve) as env:
        for strategy in STRATEGIES:
            check_same(env, sphere, scattered(40), strategy)
        check_same(env, sphere, scattered(40), "auto", exclude=[2], law=TangentPlane(250.0))


def test_many_poses_on_a_server_give_what_each_gives_by_itself(
    place: Place, sphere: PointShell
) -> None:
    with filled(place()) as env:
        for strategy in STRATEGIES:
            check_same(env, sphere, scattered(40), strategy)


def test_neighbouring_poses_share_statements(tmp_path: Path, sphere: PointShell) -> None:
    with filled(tmp_path / "e.db") as env:
        path = np.tile(np.eye(4), (200, 1, 1))
        path[:, 0, 3] = np.linspace(-0.05, 0.05, 200)
        many = env.touch_many(sphere, path)
        assert many.query.statements < 5
        assert many.query.rows > 0
        assert many.contacts is None
        assert env.touch_many(sphere, path, "array").query.statements == 200


def test_all_poses_see_one_revision(
    tmp_path: Path, place: Place, sphere: PointShell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process removes the objects between two statements of the call."""
    monkeypatch.setattr("hapticdb.query.frame.MOST_KEYS", 1)
    for url in (str(tmp_path / "e.db"), place()):
        with filled(url) as env, hapticdb.open(url) as other:
            check_one_revision(env, other, sphere)


def check_one_revision(env: Environment, other: Environment, shell: PointShell) -> None:
    poses, n_asked = np.tile(np.eye(4), (6, 1, 1)), 0
    known = HapticQuery._look_up_together

    def removing(query: HapticQuery, *given: Any) -> Any:  # noqa: ANN401 - handed on
        nonlocal n_asked
        n_asked += 1
        if n_asked == 3:
            for obj in other.objects():
                other.remove(obj.id)
        return known(query, *given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HapticQuery, "_look_up_together", removing)
        many = env.touch_many(shell, poses)
    assert n_asked == 6
    assert len(set(many.hits.tolist())) == 1
    assert many.hits[0] > 0
    assert [obj.id for obj in many.objects] == many.ids[0] != []
    assert not env.touch_many(shell, poses).hits.any()


def test_no_poses_give_nothing(tmp_path: Path, sphere: PointShell) -> None:
    with filled(tmp_path / "e.db") as env:
        nothing: list[ArrayLike] = [[], np.empty((0, 4, 4))]
        for none in nothing:
            many = env.touch_many(sphere, none, contacts=True)
            assert many.forces.shape == many.torques.shape == (0, 3)
            assert len(many) == len(many.ids) == len(many.objects) == 0
            assert many.contacts is not None
            assert len(many.contacts) == 0


def test_what_are_no_poses_is_refused_by_name(tmp_path: Path, sphere: PointShell) -> None:
    skewed = scattered(5)
    skewed[3, 0, 0] = 2.0
    with filled(tmp_path / "e.db") as env:
        for wrong, told in (
            (np.eye(4), r"poses of shape \(4, 4\): give \(n, 4, 4\)"),
            (np.zeros((2, 3, 4)), r"poses of shape \(2, 3, 4\)"),
            (scattered(2) + 0j, "poses of complex128 values"),
            (np.ma.array(scattered(2)), "poses that is a masked array"),
            (skewed, "^pose 3: .*rigid"),
        ):
            with pytest.raises(UsageError, match=told):
                env.touch_many(sphere, wrong)
        with pytest.raises(UsageError, match=r"^strategy 'fast'"):
            env.touch_many(sphere, scattered(2), "fast")  # type: ignore[arg-type]
        with pytest.raises(UsageError, match=r"^MAXGAP -1"):
            env.touch_many(sphere, scattered(2), "maxgap", maxgap=-1)
        with pytest.raises(ObjectNotFoundError, match="no object 9"):
            env.touch_many(sphere, scattered(2), exclude=[9])
