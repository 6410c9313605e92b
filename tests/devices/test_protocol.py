"""Which objects count as a device, and a simulated device on a hand without a valid pose."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hapticdb import PointShell, Session
from hapticdb.devices.protocol import Reader, Reading
from hapticdb.devices.scripted import Player
from hapticdb.devices.simulated import SimulatedDevice
from hapticdb.errors import DeviceError, UsageError
from session.hands import Odd, still

Change = Callable[[Any], object]


def placed(reading: Reading, row: int, column: int, value: float) -> Reading:
    """The reading with one number of its pose replaced."""
    pose = reading.pose.copy()
    pose[row, column] = value
    return reading._replace(pose=pose)


def turned(reading: Reading, factor: float) -> Reading:
    """The reading with its rotation multiplied by a factor."""
    pose = reading.pose.copy()
    pose[:3, :3] *= factor
    return reading._replace(pose=pose)


def unwritable(reading: Reading) -> Reading:
    """The reading with read-only arrays."""
    pose, velocity = reading.pose.copy(), reading.velocity.copy()
    pose.flags.writeable = velocity.flags.writeable = False
    return reading._replace(pose=pose, velocity=velocity)


FAULTS: list[tuple[Change, str]] = [
    (lambda r: r._replace(pose=np.eye(4)[None]), r"a pose that is an array \(1, 4, 4\) of float64"),
    (lambda r: r._replace(pose=np.eye(4).tolist()), "a pose that is of the type list"),
    (lambda r: r._replace(pose=None), "a pose that is None"),
    (lambda r: r._replace(pose=np.eye(4) + 0j), r"a pose that is an array .* of complex128"),
    (lambda r: r._replace(pose=np.eye(4).astype(str)), "a pose that is an array .* of <U32"),
    (lambda r: r._replace(pose=np.ma.array(np.eye(4))), r"a pose that is a masked array \(4, 4\)"),
    (lambda r: r._replace(velocity=np.zeros((6, 1))), r"a velocity that is an array \(6, 1\)"),
    (lambda r: r._replace(velocity=0.0), "a velocity that is of the type float"),
    (lambda r: r._replace(buttons=1.0), "buttons that are of the type float"),
    (lambda r: r._replace(buttons=-1), "buttons that are -1"),
    (lambda r: r._replace(buttons=1 << 31), "buttons that are 2147483648"),
    (lambda _: None, "None"),
    (tuple, "of the type tuple"),
]
"""Changes of a reading to what is none, and the error text for each."""
MOMENTS: list[tuple[Change, str]] = [
    (lambda r: placed(r, 1, 1, np.inf), "numbers that are not finite"),
    (lambda r: r._replace(velocity=np.full(6, np.nan)), "numbers that are not finite"),
    (lambda r: placed(r, 2, 3, 1e10), r"numbers beyond 1e\+09"),
    (lambda r: r._replace(velocity=np.full(6, -1e10)), r"numbers beyond 1e\+09"),
    (lambda r: turned(r, 1.01), "a pose that is no rigid transform"),
    (lambda r: turned(r, -1.0), "a pose that is no rigid transform"),
    (lambda r: placed(r, 0, 1, 0.1), "a pose that is no rigid transform"),
    (lambda r: placed(r, 3, 0, 1.0), "a pose that is no rigid transform"),
]
"""Changes of a reading to what is no place."""
FORMS: list[Change] = [
    lambda r: r._replace(pose=np.asfortranarray(r.pose)),
    lambda r: r._replace(pose=np.tile(r.pose, (2, 2))[4:, 4:], velocity=np.zeros(12)[::2]),
    lambda r: r._replace(pose=r.pose.astype(np.float32), velocity=r.velocity.astype(np.float32)),
    lambda r: r._replace(pose=r.pose.astype(">f8")),
    lambda r: r._replace(velocity=np.zeros(6, dtype=np.int64)),
    lambda r: turned(r, 1.0 + 1e-4),
    lambda r: r._replace(buttons=np.int32(0)),
    unwritable,
]
"""Other forms of a reading, that are taken."""


class Mute:
    """No device: it has `read`, but no `apply`."""

    def read(self) -> Reading:
        return Reading(np.eye(4), np.zeros(6), 0)


class Rows:
    """Has `poses`, as a recording has."""

    def poses(self) -> None: ...


@pytest.mark.parametrize(
    ("device", "hint"),
    [
        (
            np.tile(np.eye(4), (5, 1, 1)),
            r"an array \(5, 4, 4\) of float64 .*Player\(times, poses\)$",
        ),
        ([np.eye(4)], r"of the type list .*Player\(times, poses\)$"),
        ("path.csv", r"of the type str .*Path\(file\)$"),
        (Rows(), r"of the type Rows .*Player\(\*recording\.poses\(\)\)$"),
        (Player, r"Player is a class"),
        (Mute(), r"of the type Mute is none, it has no apply; see hapticdb\.devices\.scripted"),
        (None, r"None is none, it has no read and no apply"),
    ],
)
def test_session_rejects_non_device(
    sphere: PointShell,
    device: Any,  # noqa: ANN401 - that is the test
    hint: str,
) -> None:
    for refused in (lambda: Session("none.db", sphere, device), lambda: SimulatedDevice(device)):
        with pytest.raises(UsageError, match=rf"^device: .*{hint}") as error:
            refused()
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(("change", "told"), FAULTS)
def test_reader_bad_reading_type(change: Change, told: str) -> None:
    hand = Odd(still(0.0), change, first=2)
    for reader in (Reader(hand), SimulatedDevice(hand)):
        hand.reads = 0
        reader.read()
        with pytest.raises(DeviceError, match=rf"^Odd\.read\(\) returned {told}"):
            reader.read()


@pytest.mark.parametrize("change", FORMS)
def test_reader_accepts_other_array_forms(change: Change) -> None:
    reader = Reader(Odd(still(0.015625), change))  # exact in single precision, too
    pose, velocity, buttons = reader.read()
    assert pose[:3, 3].tolist() == [0.0, 0.0, 0.015625]
    assert (velocity.dtype.str, velocity.tolist(), int(buttons)) == ("<f8", [0.0] * 6, 0)
    assert pose.flags.carray
    assert reader.fault() == ""


@pytest.mark.parametrize(("change", "told"), MOMENTS)
def test_reader_fault_invalid_pose(change: Change, told: str) -> None:
    reader = Reader(Odd(still(0.01), change))
    reader.read()
    assert re.match(rf"Odd\.read\(\) returned {told}; expected ", reader.fault())


def test_simulated_device_resumes_after_invalid_hand() -> None:
    nowhere = Odd(still(0.25), lambda r: r._replace(velocity=np.full(6, np.nan)), 5, 5)
    device = SimulatedDevice(nowhere)
    told = [Reader(device).read() for _ in range(12)]
    assert [bool(np.isfinite(r.velocity).all()) for r in told[4:9]] == [False] * 5
    assert np.isfinite(told[-1].pose).all()
    assert told[-1].pose[2, 3] == 0.25
