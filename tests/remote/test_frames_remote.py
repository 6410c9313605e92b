"""Frames through a server are the frames on the spot, bit for bit, by every strategy."""

from pathlib import Path

import numpy as np
import pytest

import hapticdb
from hapticdb import Environment, PointShell
from hapticdb.errors import UsageError
from hapticdb.query.frame import STRATEGIES
from hapticdb.query.law import LawName
from hapticdb.testing import write_voxels
from realtime.worlds import block, poses_in
from remote.device_server import DeviceServer
from servers import Place
from smooth_scenes import imported

N_POSES = 40


def assert_same(found: hapticdb.Touch, wanted: hapticdb.Touch) -> None:
    assert found.force.tobytes() == wanted.force.tobytes()
    assert found.torque.tobytes() == wanted.torque.tobytes()
    assert found.depths.tobytes() == wanted.depths.tobytes()
    assert found.contact_depths.tobytes() == wanted.contact_depths.tobytes()
    for name in ("hits", "contacts", "pairs", "contact_pairs"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    assert [one.id for one in found.objects] == [one.id for one in wanted.objects]


def check_strategies(
    own: Environment, remote: Environment, shell: PointShell, law: LawName
) -> None:
    """Every strategy, with a filter and without, at poses that touch and poses that do not."""
    poses = poses_in(own.grid, N_POSES, beyond=-0.3)
    n_contacts = 0
    for pose in poses:
        for strategy in STRATEGIES:
            if strategy == "statement":
                continue
            for chosen in ((), ("post", "slab")):
                wanted = own.touch(shell, pose, strategy, law=law, where=chosen)
                found = remote.touch(shell, pose, strategy, law=law, where=chosen)
                assert_same(found, wanted)
                n_contacts += len(found.contacts)
    assert n_contacts > 0
    many, wanted_many = (one.touch_many(shell, poses, law=law) for one in (remote, own))
    assert many.forces.tobytes() == wanted_many.forces.tobytes()
    assert many.torques.tobytes() == wanted_many.torques.tobytes()
    assert many.ids == wanted_many.ids


def check_statement(own: Environment, remote: Environment, shell: PointShell) -> None:
    """Force summed inside the engine is force summed here; a server runs no such statement."""
    for pose in poses_in(own.grid, N_POSES, beyond=-0.3):
        wanted = own.touch(shell, pose, "statement", law="plane")
        assert_same(remote.touch(shell, pose, "array", law="plane"), wanted)
    with pytest.raises(UsageError, match="choose another strategy"):
        remote.touch(shell, np.eye(4), "statement", law="plane")


def check(url: str, server: DeviceServer, shell: PointShell) -> None:
    with imported(url) as own, hapticdb.open(server.url(url), read_only=True) as remote:
        for law in ("plane", "smooth"):
            check_strategies(own, remote, shell, law)
        check_statement(own, remote, shell)
        before = own.touch(shell, np.eye(4), law="plane")
        write_voxels(own.store, block((28, 28, 30), (36, 36, 34)), "added later")
        wanted = own.touch(shell, np.eye(4), law="plane")
        assert wanted.force.tobytes() != before.force.tobytes()
        assert_same(remote.touch(shell, np.eye(4), law="plane"), wanted)


def test_frames_through_a_server_are_those_of_sqlite(
    device_server: DeviceServer, sphere: PointShell, tmp_path: Path
) -> None:
    check(str(tmp_path / "scene.db"), device_server, sphere)


def test_frames_through_a_server_are_those_of_postgres(
    device_server: DeviceServer, sphere: PointShell, place: Place
) -> None:
    check(place(), device_server, sphere)
