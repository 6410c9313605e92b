"""A simulated device: a mass in a hand, pushed by capped forces that come late."""

import math
import time
from collections import deque

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.protocol import Reader, check_device
from hapticdb.devices.scripted import Clock, Device, Reading, SupportsEnd, SupportsRewind, capped
from hapticdb.errors import UsageError
from hapticdb.kernels.hand.handle import is_somewhere
from hapticdb.kernels.motion import pull
from hapticdb.poses import quaternion_of

STEP = 1e-4
"""Seconds of one step of the integration."""

LONGEST = 0.05
"""Seconds that a read catches up at most; what lies before is skipped."""


class SimulatedDevice:
    """A device of some mass that a hand pulls by a spring, against the wrench applied.

    The hand is critically damped: m x'' = k (h - x) + 2 sqrt(k m) (h' - x') + F, h the hand, x the
    device; turns alike. Integrated in fixed steps of 0.1 ms; the pose is carried on from the last
    step to the instant of the read.

    Parameters
    ----------
    hand : Device
        Where the person wants the device to be.
    mass, inertia : float
        Of the device, kg and kg m^2, the same about every axis.
    grip, turn_grip : float
        Stiffness of the hand, N/m and N m/rad.
    max_force, max_torque : float
        What the motors can do, N and N m; longer wrenches are shortened.
    latency : float
        Seconds from `apply` until the motors push.
    clock : callable
        Seconds; it must be possible to pickle it, and best be the hand's.

    Raises
    ------
    UsageError
        If a number is out of its range, the grip too stiff for steps of 0.1 ms, or the hand no
        device.
    """

    def __init__(
        self,
        hand: Device,
        *,
        mass: float = 0.1,
        inertia: float = 1e-4,
        grip: float = 300.0,
        turn_grip: float = 0.3,
        max_force: float = 7.0,
        max_torque: float = 0.2,
        latency: float = 1e-3,
        clock: Clock = time.perf_counter,
    ) -> None:
        numbers = (mass, inertia, grip, turn_grip, max_force, max_torque, latency)
        if not all(math.isfinite(n) and n >= 0.0 for n in numbers) or mass * inertia <= 0.0:
            raise UsageError("a simulated device takes numbers that are not negative, and a mass")
        stiffest = max(grip / mass, turn_grip / inertia)
        if STEP * math.sqrt(stiffest) > 0.5:
            raise UsageError("the grip is too stiff for so light a device; soften it or add mass")
        check_device(hand)
        self.hand = hand
        self._reader = Reader(hand)
        self.clock = clock
        self.max_force, self.max_torque, self.latency = max_force, max_torque, latency
        self._inertias = (float(mass), float(inertia))
        self._grips = (float(grip), float(turn_grip))
        self._pending: deque[tuple[float, NDArray[np.float64]]] = deque()
        self._last = np.zeros(6)
        self._pushing = np.zeros(6)
        self._time: float | None = None
        self._body = np.zeros(13)
        self._pose, self._velocity = np.eye(4), np.zeros(6)

    @property
    def is_over(self) -> bool:
        """Whether the hand has come to its end."""
        return isinstance(self.hand, SupportsEnd) and self.hand.is_over

    @property
    def last_wrench(self) -> NDArray[np.float64]:
        """The wrench (6,) applied last, N and N m, capped; the motors may not push it yet."""
        return self._last.copy()

    def rewind(self) -> None:
        """Begin anew at the next read, at rest in the hand's first pose, if the hand can."""
        if isinstance(self.hand, SupportsRewind):
            self.hand.rewind()
        self._time = None
        self._pending.clear()
        self._pushing = np.zeros(6)

    def apply(self, wrench: NDArray[np.float64]) -> None:
        """Push with a wrench (6,), N and N m, capped, from one latency later on."""
        self._last = capped(wrench, self.max_force, self.max_torque)
        self._pending.append((self.clock() + self.latency, self._last))

    def read(self) -> Reading:
        """Pose and velocity of the device now; its arrays are written anew by the next read.

        While the hand is nowhere the device is, too; it rests meanwhile.
        """
        hand = self._reader.read()
        now = self.clock()
        if not is_somewhere(hand.pose, hand.velocity):
            if self._time is not None:
                self._time = now
            return hand
        if self._time is None:
            self._time = now
            self._body[:3] = hand.pose[:3, 3]
            self._body[3:7] = quaternion_of(hand.pose[:3, :3])[0]
            self._body[7:] = hand.velocity
        self._time = max(self._time, now - LONGEST)
        while self._pending and self._pending[0][0] <= now:
            due, wrench = self._pending.popleft()
            self._move(hand, due, now)
            self._pushing = wrench
        self._move(hand, now, now)
        return Reading(self._pose, self._velocity, hand.buttons)

    def _move(self, hand: Reading, until: float, now: float) -> None:
        """Integrate in whole steps up to an instant, given the hand at another."""
        assert self._time is not None  # noqa: S101 - set by read
        # a wrench that falls due within a step pushes from the step's end on
        n_steps = max(0, int((until - self._time) / STEP + 1e-6))
        ahead = now - self._time
        self._time += n_steps * STEP
        pull(
            n_steps,
            STEP,
            ahead,
            max(0.0, now - self._time),
            hand.pose,
            hand.velocity,
            self._pushing,
            self._inertias,
            self._grips,
            self._body,
            self._pose,
            self._velocity,
        )
