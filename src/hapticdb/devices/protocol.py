"""What a device is, what it says, and the check of what it says, once a frame.

A device is two methods. What only some can do is a small Protocol of its own, and a device is
pickled into the process of the loop before it is opened there.

`Reader` believes nothing that may change between two frames. A reading of the wrong kind (its
arrays' shape or type) is a fault of the device's program: an error, which ends a session without
force. Numbers that are no place (not finite, no rotation) may be a moment's: the hand is nowhere
until the next reading that is somewhere, and the force falls as it does where nothing is known.
"""

import operator
import os
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import DeviceError, UsageError
from hapticdb.kernels.hand.handle import FARTHEST, is_somewhere

SKEW = 1e-3
"""By how much products of a rotation's columns may be off: what single precision and drift leave
passes, a turn that is scaled or mirrored does not."""
MOST_BUTTONS = (1 << 31) - 1
"""Greatest mask of buttons: 31 of them, as a recording keeps them."""
DOUBLE = np.dtype(np.float64)


class Reading(NamedTuple):
    """What a device reports."""

    pose: NDArray[np.float64]
    """(4, 4) rigid transform `world_from_hand`, metres, in the device's frame."""

    velocity: NDArray[np.float64]
    """(6,) of the hand's origin in m/s, then angular in rad/s, in the device's frame."""

    buttons: int
    """A bit for each button held down, the first button the least significant."""


class Device(Protocol):
    """What a hand holds."""

    def read(self) -> Reading:
        """Where the hand is now; a pose of NaN while the device does not know.

        Checked in every frame, see `Reader`: a reading of another kind ends the session.

        Raises
        ------
        DeviceError
            If the device does not answer or was unplugged.
        """

    def apply(self, wrench: NDArray[np.float64]) -> None:
        """Push the hand with a wrench (6,), N and N m in the device's frame, until the next call.

        The device caps it to what it can do.

        Raises
        ------
        DeviceError
            If the device does not answer or was unplugged.
        """


@runtime_checkable
class SupportsOpen(Protocol):
    """A device that is opened, once, in the process that uses it."""

    def open(self) -> None:
        """Take hold of the hardware.

        Raises
        ------
        DeviceError
            If there is no such device.
        MissingExtraError
            If the package that speaks to it is not installed.
        """


@runtime_checkable
class SupportsClose(Protocol):
    """A device that wants to know when the session ends."""

    def close(self) -> None:
        """Take the force away and let go of the hardware; a second call does nothing."""


@runtime_checkable
class SupportsEnd(Protocol):
    """A device that comes to an end: a path that is over."""

    @property
    def is_over(self) -> bool:
        """Whether the last reading was at the end, where the hand rests from then on."""


@runtime_checkable
class SupportsRewind(Protocol):
    """A device with a script, which can be begun again."""

    def rewind(self) -> None:
        """Begin anew at the next read."""


class Reader:
    """Reads a device, and gives on what a reading may be: what kernels take without a look.

    A pose (4, 4) and a velocity (6,) are arrays of float64. Others of real numbers (float32,
    integers) and of another order in memory, and arrays that cannot be written, are copied;
    lists, masked arrays, objects and complex numbers are refused.

    Notes
    -----
    A frame's check takes 2 to 4 us of Python beside the device's own time, a fifth of them for the
    arrays' type, shape and layout, the rest for the rotation; 11 us where arrays are copied
    (one virtual processor of a shared Xeon, the host idle and busy).
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self._pose, self._velocity = np.empty((4, 4)), np.empty(6)
        self._nowhere = np.full((4, 4), np.nan)
        self._last: Reading | None = None

    def read(self) -> Reading:
        """Where the hand is now; a pose of NaN where it is no rigid transform.

        Raises
        ------
        DeviceError
            The device's own, or when what it returns is of the wrong kind.
        """
        reading = self.device.read()
        if type(reading) is not Reading:
            raise self._refused(
                f"{_kind_of(reading)}",
                "a hapticdb.devices.scripted.Reading(pose, velocity, buttons)",
            )
        pose, velocity, buttons = reading
        if not (
            type(pose) is np.ndarray
            and type(velocity) is np.ndarray
            and type(buttons) is int
            and pose.dtype is DOUBLE
            and velocity.dtype is DOUBLE
            and pose.shape == (4, 4)
            and velocity.shape == (6,)
            and pose.flags.carray
            and velocity.flags.carray
            and 0 <= buttons <= MOST_BUTTONS
        ):
            reading = self._converted(reading)
            pose = reading.pose
        self._last = reading
        return reading if is_rigid_enough(pose) else reading._replace(pose=self._nowhere)

    def complaint(self) -> str:
        """What is wrong with the numbers of the last reading, in a line; nothing for none."""
        last = self._last
        if last is None:
            return ""
        if not (np.isfinite(last.pose).all() and np.isfinite(last.velocity).all()):
            return self._said("numbers that are not finite", "finite ones")
        if not is_rigid_enough(last.pose):
            return self._said(
                "a pose that is no rigid transform",
                f"a rotation to {SKEW:g}, and a last row 0 0 0 1",
            )
        if not is_somewhere(last.pose, last.velocity):
            return self._said(f"numbers beyond {FARTHEST:g}", "metres, m/s and rad/s")
        return ""

    def _converted(self, reading: Reading) -> Reading:
        """A reading whose arrays are ours, from one that is right but for its form."""
        self._take("pose", reading.pose, self._pose)
        self._take("velocity", reading.velocity, self._velocity)
        try:
            buttons = operator.index(reading.buttons)
        except TypeError:
            buttons = -1
        if not 0 <= buttons <= MOST_BUTTONS:
            shown = (
                repr(int(reading.buttons))
                if isinstance(reading.buttons, (int, np.integer))
                else _kind_of(reading.buttons)
            )
            raise self._refused(f"buttons that are {shown}", "an int, a bit for each of 31 buttons")
        return Reading(self._pose, self._velocity, buttons)

    def _take(self, what: str, given: object, into: NDArray[np.float64]) -> None:
        if (
            not isinstance(given, np.ndarray)
            or isinstance(given, np.ma.MaskedArray)
            or given.shape != into.shape
            or given.dtype.kind not in "fiu"
        ):
            shape = ", ".join(map(str, into.shape))
            raise self._refused(
                f"a {what} that is {_kind_of(given)}",
                f"an array ({shape}{',' if into.ndim == 1 else ''}) of float64",
            )
        into[...] = given

    def _refused(self, returned: str, expected: str) -> DeviceError:
        return DeviceError(self._said(returned, expected))

    def _said(self, returned: str, expected: str) -> str:
        return f"{type(self.device).__name__}.read() returned {returned}; expected {expected}"


def is_rigid_enough(pose: NDArray[np.float64]) -> bool:
    """Whether a pose (4, 4) turns by a rotation, to `SKEW`, and has the last row 0 0 0 1."""
    # products written out on plain floats: a quarter of what array operations take
    (a, b, c, _), (d, e, f, _), (g, h, i, _), last = pose.tolist()
    return bool(
        abs(a * a + d * d + g * g - 1.0) <= SKEW
        and abs(b * b + e * e + h * h - 1.0) <= SKEW
        and abs(c * c + f * f + i * i - 1.0) <= SKEW
        and abs(a * b + d * e + g * h) <= SKEW
        and abs(a * c + d * f + g * i) <= SKEW
        and abs(b * c + e * f + h * i) <= SKEW
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
        and last == [0.0, 0.0, 0.0, 1.0]
    )


def check_device(device: object) -> None:
    """Refuse what is no device, and say what to pass in its place.

    Raises
    ------
    UsageError
        When it lacks `read` or `apply`, or is a class.
    """
    if isinstance(device, type):
        raise UsageError(
            f"device: {device.__name__} is a class; pass one that is made, as by ...()"
        )
    lacking = [name for name in ("read", "apply") if not callable(getattr(device, name, None))]
    if not lacking:
        return
    if isinstance(device, (np.ndarray, list, tuple)):
        hint = "to play poses (M, 4, 4), pass hapticdb.devices.scripted.Player(times, poses)"
    elif isinstance(device, (str, os.PathLike)):
        hint = "to follow a file of poses, pass hapticdb.devices.scripted.Path(file)"
    elif callable(getattr(device, "poses", None)):
        hint = "to play a recording, pass hapticdb.devices.scripted.Player(*recording.poses())"
    else:
        hint = "see hapticdb.devices.scripted for those that there are"
    raise UsageError(
        f"device: {_kind_of(device)} is none, it has no {' and no '.join(lacking)}; {hint}"
    )


def _kind_of(value: object) -> str:
    """What something is, in a few words."""
    if value is None:
        return "None"
    if isinstance(value, np.ndarray):
        masked = "a masked" if isinstance(value, np.ma.MaskedArray) else "an"
        return f"{masked} array {value.shape} of {value.dtype}"
    return f"of the type {type(value).__name__}"
