"""Which objects count as a device, and a simulated device on a hand without a valid pose."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.readings import FAULTS, FORMS, MOMENTS, Change
from hapticdb import PointShell, Session
from hapticdb.devices.protocol import Reader, Reading
from hapticdb.devices.scripted import Line
from hapticdb.devices.simulated import SimulatedDevice
from hapticdb.errors import DeviceError, UsageError
from realtime.hands import Odd, still


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
        (Path("path.csv"), r"Path\(file\)$"),
        (Rows(), r"of the type Rows .*Player\(\*recording\.poses\(\)\)$"),
        (Line, r"Line is a class"),
        (Mute(), r"of the type Mute is none, it has no apply; see hapticdb\.devices\.scripted"),
        (None, r"None is none, it has no read and no apply"),
    ],
)
def test_what_is_no_device_is_refused_with_what_to_pass_instead(
    sphere: PointShell,
    device: Any,  # noqa: ANN401 - that is the test
    hint: str,
) -> None:
    for refused in (lambda: Session("none.db", sphere, device), lambda: SimulatedDevice(device)):
        with pytest.raises(UsageError, match=rf"^device: .*{hint}") as error:
            refused()
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(("change", "told"), FAULTS)
def test_a_reading_of_the_wrong_kind_is_refused(change: Change, told: str) -> None:
    hand = Odd(still(0.0), change, first=2)
    for reader in (Reader(hand), SimulatedDevice(hand)):
        hand.reads = 0
        reader.read()
        with pytest.raises(DeviceError, match=rf"^Odd\.read\(\) returned {told}"):
            reader.read()


@pytest.mark.parametrize("change", FORMS)
def test_a_reading_of_another_form_is_taken_as_it_is(change: Change) -> None:
    reader = Reader(Odd(still(0.015625), change))  # exact in single precision, too
    pose, velocity, buttons = reader.read()
    assert pose[:3, 3].tolist() == [0.0, 0.0, 0.015625]
    assert (velocity.dtype.str, velocity.tolist(), int(buttons)) == ("<f8", [0.0] * 6, 0)
    assert pose.flags.carray
    assert reader.complaint() == ""


@pytest.mark.parametrize(("change", "told"), MOMENTS)
def test_a_reading_that_is_no_place_is_told(change: Change, told: str) -> None:
    reader = Reader(Odd(still(0.01), change))
    reader.read()
    assert re.match(rf"Odd\.read\(\) returned {told}; expected ", reader.complaint())


def test_a_simulated_device_goes_on_when_its_hand_is_somewhere_again() -> None:
    nowhere = Odd(still(0.25), lambda r: r._replace(velocity=np.full(6, np.nan)), 5, 5)
    device = SimulatedDevice(nowhere)
    told = [Reader(device).read() for _ in range(12)]
    assert [bool(np.isfinite(r.velocity).all()) for r in told[4:9]] == [False] * 5
    assert np.isfinite(told[-1].pose).all()
    assert told[-1].pose[2, 3] == 0.25
