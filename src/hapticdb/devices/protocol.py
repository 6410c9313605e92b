"""Device protocol, readings, and their check in every frame.

A device has two methods, `read` and `apply`. Each optional ability is a small Protocol of its own.
A device is pickled into the process of the loop and opened there.

`Reader` checks in every frame whatever may change between two frames. A reading of the wrong kind
(shape or type of its arrays) is a fault of the device's program: it raises an error, and the
session ends without force. Numbers without a valid pose (not finite, no rotation) are a transient:
the hand's pose is unknown until the next valid reading, and the force decays as in cells that are
not resident.
"""

import operator
import os
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import DeviceError, UsageError
from hapticdb.kernels.hand.handle_motion import FARTHEST, is_valid_pose

SKEW = 1e-3
"""Greatest error of the dot products of a rotation's columns, 0 or 1 when exact. Rounding to single
precision and drift stay below it, a scaled rotation does not."""
MOST_BUTTONS = (1 << 31) - 1
"""Greatest mask of buttons: 31 bits, as a recording stores them."""
DOUBLE = np.dtype(np.float64)


class Reading(NamedTuple):
    """Pose and velocity of the hand, and its pressed buttons."""

    pose: NDArray[np.float64]
    """(4, 4) rigid transform `world_from_hand`, metres, in the device's frame."""

    velocity: NDArray[np.float64]
    """(6,) linear velocity of the hand's origin in m/s, then angular in rad/s; device's frame."""

    buttons: int
    """Mask of the buttons, 1 for a pressed one; the first button is the lowest bit."""


class Device(Protocol):
    """A haptic device: it measures the hand's motion, and applies a wrench to the hand.

    Both methods raise `DeviceError` if the device does not answer or was unplugged.
    """

    def read(self) -> Reading:
        """Return the hand's present pose and velocity; a pose of NaN while it is unknown."""

    def apply(self, wrench: NDArray[np.float64]) -> None:
        """Push the hand with a wrench (6,), N and N m in the device's frame, until the next call.

        The device limits the wrench to the caps of its motors.
        """


@runtime_checkable
class SupportsOpen(Protocol):
    """A device with a connection, opened once in the process that uses it."""

    def open(self) -> None:
        """Connect to the hardware; raises `DeviceError` or `MissingExtraError`."""


@runtime_checkable
class SupportsClose(Protocol):
    """A device with resources, released at the end of the session."""

    def close(self) -> None:
        """Set the force to zero and release the hardware; a second call does nothing."""


@runtime_checkable
class SupportsEnd(Protocol):
    """A device with a finite script, such as a path."""

    @property
    def is_over(self) -> bool:
        """Whether the last reading was at the end of the script, the hand's resting pose."""


@runtime_checkable
class SupportsRewind(Protocol):
    """A device with a script that can start again."""

    def rewind(self) -> None:
        """Restart the script at the next read."""


class Reader:
    """Readings of a device, checked and converted for the kernels.

    A pose (4, 4) and a velocity (6,) are arrays of float64. Arrays of other real numbers (float32,
    integers), of another memory order or read-only are copied; lists, masked arrays, objects and
    complex numbers are refused.

    The check adds 2 to 4 us to a frame, and 11 us if arrays are copied (a shared Xeon).
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self._pose, self._velocity = np.empty((4, 4)), np.empty(6)
        self._nowhere = np.full((4, 4), np.nan)
        self._last: Reading | None = None

    def read(self) -> Reading:
        """Return the device's reading; its pose is NaN if it was no rigid transform.

        Raises `DeviceError` if the device does, or if the reading is of the wrong kind.
        """
        reading = self.device.read()
        if type(reading) is not Reading:
            form = "a hapticdb.devices.protocol.Reading(pose, velocity, buttons)"
            raise self._refused(_kind_of(reading), form)
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
        return reading if _is_rigid_enough(pose) else reading._replace(pose=self._nowhere)

    def fault(self) -> str:
        """Fault of the last reading's numbers, in one line; empty without one."""
        last = self._last
        if last is None:
            return ""
        if not (np.isfinite(last.pose).all() and np.isfinite(last.velocity).all()):
            return self._said("numbers that are not finite", "finite ones")
        if not _is_rigid_enough(last.pose):
            return self._said(
                "a pose that is no rigid transform",
                f"a rotation to {SKEW:g}, and a last row 0 0 0 1",
            )
        if not is_valid_pose(last.pose, last.velocity):
            return self._said(f"numbers beyond {FARTHEST:g}", "metres, m/s and rad/s")
        return ""

    def _converted(self, reading: Reading) -> Reading:
        """Copy a reading with arrays of another type or memory order into own arrays."""
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


def _is_rigid_enough(pose: NDArray[np.float64]) -> bool:
    """Whether a pose (4, 4) has a rotation, exact to `SKEW`, and the last row 0 0 0 1."""
    # plain floats, products written out: a quarter of the time of array operations
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
    """UsageError for an object without `read` or `apply`, or a class; hints at what to pass."""
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
    """Type of a value in a few words, for messages."""
    if value is None:
        return "None"
    if isinstance(value, np.ndarray):
        masked = "a masked" if isinstance(value, np.ma.MaskedArray) else "an"
        return f"{masked} array {value.shape} of {value.dtype}"
    return f"of the type {type(value).__name__}"
