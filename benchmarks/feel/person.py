"""A simulated person: a mass on a spring and a damper, pushed by a device, on a counted clock.

The hand and the device's end are one mass. Grip and device are linear, so a period under constant
force is stepped exactly, by the exponential of a matrix; nothing is lost to integration.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Floats = NDArray[np.float64]

DEVICE_KG = 0.1
"""Mass of the device's end and the fingers that move with it, kg."""
DEVICE_DAMPING = 0.2
"""Damping of the device itself, N s/m: a light, well-made one. Larger: stiffer walls are stable."""


@dataclass(frozen=True)
class Grip:
    """How a hand holds the device.

    name : for tables; stiffness, N/m, and damping, N s/m, between the device and the point where
    the arm wants it to be.
    """

    name: str
    stiffness: float
    damping: float


def grip_of(name: str, stiffness: float, damping_ratio: float) -> Grip:
    """A grip whose damping is a share of the critical one for the device's mass."""
    return Grip(name, stiffness, 2.0 * damping_ratio * (stiffness * DEVICE_KG) ** 0.5)


LIGHT = grip_of("light grip", 100.0, 0.3)
FIRM = grip_of("firm grip", 1000.0, 0.5)
"""The two grips: b = 0.6 sqrt(100 m) and b = sqrt(1000 m)."""


class Person:
    """A hand on a device, in one period after another.

    grip : how the device is held; period : seconds; delay : seconds from sending a force until it
    acts, a whole number of periods; start (3,): where hand and device are, at rest, metres.
    position, velocity (3,) are the device's, m and m/s.
    """

    def __init__(self, grip: Grip, period: float, delay: float, start: Floats) -> None:
        self.position = np.array(start, dtype=np.float64)
        self.velocity = np.zeros(3)
        self._target = self.position.copy()
        self._under_way = deque([np.zeros(3)] * round(delay / period))
        self._period = period
        self._step = step_matrix(grip, period)

    def move(self, force: Floats, target: Floats) -> None:
        """Live through one period.

        force (3,): sent at its start, N; target (3,): where the arm wants the device at its end,
        metres; it moves there at a constant speed.
        """
        self._under_way.append(np.array(force))
        pushing = self._under_way.popleft()
        rate = (target - self._target) / self._period
        state = np.stack([self.position, self.velocity, pushing, self._target, rate])
        self.position, self.velocity = self._step @ state
        self._target = np.array(target)


def step_matrix(grip: Grip, period: float) -> Floats:
    """Matrix (2, 5) from (x, v, force, target, target's speed) to (x, v) one period later."""
    k, b, m = grip.stiffness, grip.damping, DEVICE_KG
    rates = np.zeros((5, 5))
    rates[0, 1] = 1.0
    rates[1] = -k / m, -(b + DEVICE_DAMPING) / m, 1.0 / m, k / m, b / m
    rates[3, 4] = 1.0
    return np.asarray(expm(rates * period)[:2])
