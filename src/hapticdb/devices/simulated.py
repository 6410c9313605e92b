"""Simulated device: a mass on the spring of a hand, with capped forces and a latency."""

import math
import time
from collections import deque

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.profiles import HAND_CAP, HAND_STIFFNESS, STIFFEST, DeviceProfile
from hapticdb.devices.protocol import (
    Device,
    Reader,
    Reading,
    SupportsEnd,
    SupportsRewind,
    check_device,
)
from hapticdb.devices.scripted import Clock, capped
from hapticdb.errors import UsageError
from hapticdb.kernels.hand.handle_motion import is_valid_pose
from hapticdb.kernels.hand_motion import pull
from hapticdb.poses import quaternion_of

STEP = 1e-4
"""Time step of the integration, s. Larger: less work a read, but only softer grips."""

INERTIA, TURN_GRIP, MAX_TORQUE = 1e-4, 1e-3, 0.2
"""Moment of inertia, kg m^2; rotational stiffness of a grip, N m/rad per N/m; torque cap, N m."""
LONGEST = 0.05
"""Longest time, s, that one read integrates; after a longer pause the time before is skipped."""


class SimulatedDevice:
    """A device with a mass: the hand pulls it by a spring, the applied wrench pushes it.

    The spring is critically damped: m x'' = k (h - x) + 2 sqrt(k m) (h' - x') + F, with the hand h
    and the device x. Rotations follow the same law. The integration has fixed steps of 0.1 ms; the
    pose is extrapolated from the last step to the instant of the read.

    hand : intended motion of the device, as readings; mass : of the device, kg, its moment of
    inertia is 1e-4 kg m^2 about every axis; grip : stiffness of the hand, N/m, for rotations a
    thousandth of it, N m/rad; max_force : of the motors, N, their greatest torque is 0.2 N m;
    latency : seconds from `apply` until the motors push; clock : seconds, picklable, the hand's.

    Raises `UsageError` if a number is out of its range, the grip is too stiff for steps of 0.1 ms,
    or the hand is no device.
    """

    def __init__(
        self, hand: Device, *, mass: float = 0.1, grip: float = 300.0, max_force: float = HAND_CAP,
        latency: float = 1e-3, clock: Clock = time.perf_counter,
    ) -> None:  # fmt: skip
        numbers = (mass, grip, max_force, latency)
        if not all(math.isfinite(n) and n >= 0.0 for n in numbers) or mass <= 0.0:
            raise UsageError("a simulated device takes numbers that are not negative, and a mass")
        stiffest = max(grip / mass, TURN_GRIP * grip / INERTIA)
        if STEP * math.sqrt(stiffest) > 0.5:
            raise UsageError("the grip is too stiff for so light a device; soften it or add mass")
        check_device(hand)
        self.hand = hand
        self._reader = Reader(hand)
        self.clock = clock
        self.max_force, self.latency = max_force, latency
        self._inertias, self._grips = (float(mass), INERTIA), (float(grip), TURN_GRIP * grip)
        self._pending: deque[tuple[float, NDArray[np.float64]]] = deque()
        self._pushing = np.zeros(6)
        self._time: float | None = None
        self._body = np.zeros(13)
        self._pose, self._velocity = np.eye(4), np.zeros(6)

    @property
    def profile(self) -> DeviceProfile:
        """Caps, mass and delay of the device; the damping of its hand is that of the grip."""
        mass, grip = self._inertias[0], self._grips[0]
        least = 1e-6  # cap of a device without motors
        return DeviceProfile(
            "simulated", max(self.max_force, least), STIFFEST, STIFFEST, mass=mass,
            hand_damping=2.0 * math.sqrt(grip * mass), usual_stiffness=HAND_STIFFNESS,
            torque_cap=MAX_TORQUE, delay=self.latency,
        )  # fmt: skip

    @property
    def is_over(self) -> bool:
        """Whether the hand's script is over."""
        return isinstance(self.hand, SupportsEnd) and self.hand.is_over

    def rewind(self) -> None:
        """Restart at the next read, in the hand's pose; the hand rewinds too if it can."""
        if isinstance(self.hand, SupportsRewind):
            self.hand.rewind()
        self._time = None
        self._pending.clear()
        self._pushing = np.zeros(6)

    def apply(self, wrench: NDArray[np.float64]) -> None:
        """Push with a wrench (6,), N and N m, capped; it acts after the latency."""
        push = capped(wrench, self.max_force, MAX_TORQUE)
        self._pending.append((self.clock() + self.latency, push))

    def read(self) -> Reading:
        """Pose and velocity of the device now; the next read overwrites the arrays.

        Without a valid pose of the hand the device has none either, and does not move.
        """
        hand = self._reader.read()
        now = self.clock()
        if not is_valid_pose(hand.pose, hand.velocity):
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
        """Integrate in whole steps up to `until` (s); `hand` is the hand's reading at `now` (s)."""
        assert self._time is not None  # noqa: S101 - set by read
        # a wrench that becomes due within a step acts from the end of that step
        n_steps = max(0, int((until - self._time) / STEP + 1e-6))
        ahead = now - self._time
        self._time += n_steps * STEP
        pull(
            n_steps, STEP, ahead, max(0.0, now - self._time), hand.pose, hand.velocity,
            self._pushing, self._inertias, self._grips, self._body, self._pose, self._velocity,
        )  # fmt: skip
