"""Scripted devices: their poses, velocities and ends."""

import math
import pickle
from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb import write_poses
from hapticdb.devices.protocol import Device, Reading
from hapticdb.devices.scripted import CYCLE, Path, Player, RandomHand, capped, pose_at
from hapticdb.errors import UsageError
from hapticdb.poses import quaternion_of, rotation_of


class SetClock:
    """A clock in seconds that only a test moves."""

    def __init__(self, now: float = 0.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now


def quarter(axis: int) -> NDArray[np.float64]:
    """A pose at the origin, turned by 90 degrees about an axis of the world."""
    q = np.zeros(4)
    q[[0, axis + 1]] = math.sqrt(0.5)
    pose = np.eye(4)
    pose[:3, :3] = rotation_of(q)[0]
    return pose


TURNED = quarter(1) @ quarter(2)
TURNED[:3, 3] = 0.2, -0.1, 0.4

MAKERS: dict[str, Callable[[SetClock], Device]] = {
    "player": lambda clock: Player([0.0, 0.5, 2.0], [np.eye(4), TURNED, quarter(0)], clock=clock),
    "random": lambda clock: RandomHand(TURNED, 3, 0.5, 4.0, clock=clock),
}


def kept(reading: Reading) -> Reading:
    """A copy of a reading, which the next read does not change."""
    return Reading(reading.pose.copy(), reading.velocity.copy(), reading.buttons)


def difference(before: Reading, after: Reading, seconds: float) -> NDArray[np.float64]:
    """Velocity (6,) between two readings."""
    turn = after.pose[:3, :3] @ before.pose[:3, :3].T
    q = quaternion_of(turn)[0]
    sine = np.linalg.norm(q[1:])
    angular = q[1:] * (2.0 * math.atan2(sine, q[0]) / sine if sine > 0.0 else 0.0)
    return np.concatenate([after.pose[:3, 3] - before.pose[:3, 3], angular]) / seconds


def read_at(device: Device, clock: SetClock, seconds: float) -> Reading:
    """The reading so many seconds after the device's start at 100 s."""
    clock.now = 100.0 + seconds
    return kept(device.read())


@pytest.mark.parametrize("name", MAKERS)
@given(instant=st.floats(0.01, 40.0))
@settings(max_examples=10, deadline=None)
def test_scripted_poses_rigid_and_velocities_match(name: str, instant: float) -> None:
    clock = SetClock(100.0)
    device = MAKERS[name](clock)
    device.read()
    h = 1e-5
    before, at, after = (read_at(device, clock, instant + d) for d in (-h, 0.0, h))
    # else a corner of the path lies between the readings
    if np.allclose(before.velocity, after.velocity, atol=0.05):
        assert np.allclose(difference(before, after, 2 * h), at.velocity, atol=2e-5)
    pose = at.pose
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) > 0.0
    assert pose[3].tolist() == [0.0, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("name", MAKERS)
def test_scripted_devices_pickle_state(name: str) -> None:
    clock = SetClock(100.0)
    device = MAKERS[name](clock)
    read_at(device, clock, 0.0)
    read_at(device, clock, 0.3)
    twin = pickle.loads(pickle.dumps(device))  # noqa: S301 - its own
    for seconds in (0.4, 1.1, 7.0):
        twin.clock.now = 100.0 + seconds
        ours, theirs = read_at(device, clock, seconds), twin.read()
        assert np.array_equal(ours.pose, theirs.pose)
        assert np.array_equal(ours.velocity, theirs.velocity)


def test_player_starts_at_first_read() -> None:
    clock = SetClock(100.0)
    ends = np.tile(np.eye(4), (2, 1, 1))
    ends[:, :3, 3] = (1.0, 2.0, 3.0), (2.0, 2.0, 3.0)
    line = Player([0.0, 2.0], ends, clock=clock)
    clock.now = 5000.0
    assert line.read().pose[:3, 3].tolist() == [1.0, 2.0, 3.0]
    clock.now = 5001.0
    assert np.allclose(line.read().pose[:3, 3], [1.5, 2.0, 3.0])
    assert np.allclose(line.read().velocity, [0.5, 0, 0, 0, 0, 0])


def test_player_rests_at_last_pose() -> None:
    clock = SetClock(100.0)
    player = Player([3.0, 4.0, 5.0], [np.eye(4), TURNED, quarter(2)], clock=clock)
    assert not player.is_over
    player.read()
    read_at(player, clock, 1.999)
    assert not player.is_over
    for seconds in (2.0, 2.5, 1e6):
        last = read_at(player, clock, seconds)
        assert player.is_over
        assert np.allclose(last.pose, quarter(2), atol=1e-15)
        assert last.velocity.tolist() == [0.0] * 6


def test_player_constant_angular_velocity() -> None:
    clock = SetClock(100.0)
    player = Player([0.0, 3.0], [np.eye(4), quarter(2)], clock=clock)
    player.read()
    third = read_at(player, clock, 1.0)
    assert np.allclose(third.pose[:2, 0], [math.cos(math.pi / 6), math.sin(math.pi / 6)])
    assert np.allclose(third.velocity, [0, 0, 0, 0, 0, math.pi / 6])


def test_player_loop_never_over() -> None:
    clock = SetClock(100.0)
    places = [pose_at((x, 0.0, 0.0)) for x in (0.0, 1.0, 0.0)]
    line = Player([0.0, 1.0, 2.0], places, loops=True, clock=clock)
    line.read()
    xs = [read_at(line, clock, s).pose[0, 3] for s in (0.25, 0.75, 1.25, 1.75, 2.25)]
    assert np.allclose(xs, [0.25, 0.75, 0.75, 0.25, 0.25])
    assert np.allclose(read_at(line, clock, 1.5).velocity[0], -1.0)
    assert not line.is_over


@given(speed=st.floats(0.05, 2.0), seed=st.integers(0, 1000))
@settings(max_examples=5, deadline=None)
def test_random_hand_peak_speed(speed: float, seed: int) -> None:
    clock = SetClock(100.0)
    hand = RandomHand((1, 2, 3), seed, speed, 2.0 * speed, 0.3, clock=clock)
    start = kept(hand.read())
    assert np.allclose(start.pose, pose_at((1, 2, 3)), atol=1e-12)
    readings = [read_at(hand, clock, s) for s in np.linspace(0.0, CYCLE, 4001)]
    speeds = np.linalg.norm([r.velocity[:3] for r in readings], axis=1)
    turning = np.linalg.norm([r.velocity[3:] for r in readings], axis=1)
    ways = np.linalg.norm([r.pose[:3, 3] - (1, 2, 3) for r in readings], axis=1)
    assert speeds.max() == pytest.approx(speed, rel=5e-3)
    assert turning.max() == pytest.approx(2.0 * speed, rel=5e-3)
    assert ways.max() <= 0.3001
    assert np.allclose(readings[-1].pose, start.pose, atol=1e-9)


def test_random_hand_unreachable_speed() -> None:
    with pytest.raises(UsageError, match=r"no hand reaches 5 m/s within 0.01 m"):
        RandomHand((0, 0, 0), speed=5.0, reach=0.01)


def test_path_device_constant_speed(tmp_path: FilePath) -> None:
    clock = SetClock(100.0)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1:, 0, 3] = 0.1, 0.1, 0.3
    write_poses(tmp_path / "p.csv", poses)
    path = Path(tmp_path / "p.csv", clock=clock)
    assert path.duration == pytest.approx(3.0)  # 0.3 m at 0.1 m/s; two equal poses add no time
    path.read()
    assert read_at(path, clock, 1.7).velocity[0] == pytest.approx(0.1)
    assert Path(tmp_path / "p.csv", speed=0.6).duration == pytest.approx(0.5)


def test_path_device_times_of_file(tmp_path: FilePath) -> None:
    file = tmp_path / "p.csv"
    file.write_text("x,y,z,qw,qx,qy,qz,t\n0,0,0,1,0,0,0,1\n1,0,0,1,0,0,0,2\n1,1,0,1,0,0,0,5\n")
    clock = SetClock(100.0)
    path = Path(file, clock=clock)
    path.read()
    assert path.duration == 4.0
    assert np.allclose(read_at(path, clock, 1.0).pose[:3, 3], [1, 0, 0])
    assert Path(file, speed=1.0).duration == pytest.approx(2.0)


def test_player_bad_times() -> None:
    makers: tuple[Callable[[], Device], ...] = (
        lambda: Player([0.0, 0.0], [np.eye(4)] * 2),
        lambda: Player([], np.empty((0, 4, 4))),
        lambda: Player([0.0, math.nan], [np.eye(4)] * 2),
    )
    for make in makers:
        with pytest.raises(UsageError) as caught:
            make()
        assert "\n" not in str(caught.value)


@given(st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=6))
def test_capped_keeps_direction(values: list[float]) -> None:
    wrench = np.array(values)
    given_before = wrench.copy()
    out = capped(wrench, 7.0, 0.2)
    for part, cap in ((slice(0, 3), 7.0), (slice(3, 6), 0.2)):
        length = float(np.linalg.norm(wrench[part]))
        assert np.linalg.norm(out[part]) == pytest.approx(min(length, cap))
        assert np.allclose(np.cross(out[part], wrench[part]), 0.0, atol=1e-9 * max(length, 1.0))
    assert np.array_equal(wrench, given_before)


def test_capped_non_finite_is_zero() -> None:
    for bad in (math.nan, math.inf, -math.inf):
        assert capped(np.array([bad, 1, 1, 0.1, 0, 0]), 7.0, 0.2).tolist() == [0, 0, 0, 0.1, 0, 0]
        assert capped(np.array([1, 0, 0, 0, 0, bad]), 7.0, 0.2).tolist() == [1, 0, 0, 0, 0, 0]
