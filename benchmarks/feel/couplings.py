"""The coupling of the distance law, period by period in this process.

No loop, no clock and no device: a measure gives the hand's place and reads the force.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from feel.ground import Ground
from hapticdb.devices.handle import Handle
from hapticdb.devices.protocol import Reading
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.records.layout import pose_numbers
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import DISTANCE
from hapticdb.resident.point_runs import clusters_of
from hapticdb.session.states import PeriodClock, SessionState

Floats = NDArray[np.float64]

STIFFNESS = 1000.0
"""Stiffness at the device, N/m, where a measure names no other."""
RATE = 1000.0
"""Periods a second, where a measure names no other."""
CAP = 20.0
"""Most force of the distance law's device, N: above all that is wanted of it here. Larger: stiffer
contacts in its coupling."""
REST = 40
"""Periods that a tool rests at its first place: a session's force rises within 20 ms. Larger: a
session at a higher rate has risen, too; each measure takes longer."""


@dataclass(frozen=True)
class Terms:
    """Terms of a session.

    stiffness, N/m, at the device; rate: periods a second; delay: seconds from sending a force until
    it acts.
    """

    stiffness: float = STIFFNESS
    rate: float = RATE
    delay: float = 0.0


class CoupledHand:
    """A hand with a tool that rests where forces balance, from one period to the next.

    The tool is at rest at the pose (4, 4) of the device, and has been there for `REST` periods. The
    damper cancels what delay gives, as in a session: B = K (T / 2 + t_d).
    """

    def __init__(self, ground: Ground, shell: PointShell, pose: Floats, terms: Terms) -> None:
        self._periods = PeriodClock(DISTANCE)
        self._state = SessionState(
            self._periods.slots[0, ...], ground.table.cells, 0, ground.table.queue.requests[0, ...],
            ground.residency.grid, clusters_of(shell, ground.size),
        )  # fmt: skip
        self._hand, self._sent = self._state.servo["hand"], self._state.servo["sent"]
        self._handle = Handle()
        self._period = 1.0 / terms.rate
        self._handle.start(Reading(pose, np.zeros(6), 0), self._hand)
        self._state.rest_at(pose_numbers(self._hand).copy())
        reach = float(np.linalg.norm(shell.points - shell.center, axis=1).max())
        lever = max(reach, ground.size)
        spring = DeviceSpring(
            stiffness=terms.stiffness,
            turn_stiffness=terms.stiffness * lever**2,
            cap=CAP,
            turn_cap=CAP * lever,
            damping=terms.stiffness * (0.5 / terms.rate + terms.delay),
            scale=1.0,
            radius=reach,
            hold=0.02,
            fade=0.02,
        )
        self._state.set_spring(spring)
        self._periods.enter(self._state)
        self._state.slot["staleness"] = np.iinfo(np.int64).max
        for _ in range(round(REST / (self._period * RATE))):
            self.step(pose, np.zeros(6))

    def step(self, pose: Floats, velocity: Floats) -> Floats:
        """Force (3,) on the device after one period, N.

        pose (4, 4) and velocity (6,): of the device, metres of the device; the array that is
        returned is the caller's own.
        """
        self._handle.follow(Reading(pose, velocity, 0), self._hand)
        self._periods.step(self._period, 0)
        return np.array(self._sent["wrench"][:3])


class Drive(NamedTuple):
    """A hand's way: positions (M, 3) of the device, and forces (M, 3) on it."""

    positions: Floats
    forces: Floats


def posed(position: Floats) -> Floats:
    """Pose (4, 4), upright, at a position (3,)."""
    pose = np.eye(4)
    pose[:3, 3] = position
    return pose


def drive(hand: CoupledHand, positions: Floats, rate: float = RATE) -> Drive:
    """Lead a hand along positions (M, 3), one a period, upright."""
    velocities = np.zeros((len(positions), 6))
    velocities[1:, :3] = np.diff(positions, axis=0) * rate
    forces = np.empty_like(positions)
    pose = np.eye(4)
    for n, (position, velocity) in enumerate(zip(positions, velocities, strict=True)):
        pose[:3, 3] = position
        forces[n] = hand.step(pose, velocity)
    return Drive(positions, forces)


def straight(start: Floats, end: Floats, speed: float, rate: float = RATE) -> Floats:
    """Positions (M, 3) from start to end, both included, at a speed in m/s."""
    way = float(np.linalg.norm(end - start))
    count = max(round(way / speed * rate), 1)
    return np.asarray(start + np.linspace(0.0, 1.0, count + 1)[:, None] * (end - start))
