"""The coupling of the distance law, period by period in this process, and figures of its forces.

No loop, no clock and no device: a measure gives the hand's place and reads the force.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from feel.ground import Floats, Ground, Stand, flat_tool, posed
from hapticdb.devices.handle import Handle
from hapticdb.devices.protocol import Reading
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.records.layout import pose_numbers
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import DISTANCE
from hapticdb.resident.point_runs import clusters_of
from hapticdb.session.states import PeriodClock, SessionState

STIFFNESS = 1000.0
"""Stiffness at the device, N/m, where a measure names no other."""
RATE = 1000.0
"""Periods a second, where a measure names no other."""
SPEED = 0.05
"""Speed of a sliding hand, m/s: 0.05 mm a period."""
ABOVE = 0.002
"""Height above the onset from which a hand comes, metres."""
CAP = 20.0
"""Most force of the distance law's device, N: above all that is wanted of it here. Larger: stiffer
contacts in its coupling."""
REST = 40
"""Periods that a tool rests at its first place: a session's force rises within 20 ms. Larger: a
session at a higher rate has risen, too; each measure takes longer."""


class Terms(NamedTuple):
    """Terms of a session.

    stiffness, N/m, at the device; rate: periods a second; delay: seconds from sending a force until
    it acts.
    """

    stiffness: float = STIFFNESS
    rate: float = RATE
    delay: float = 0.0


USUAL = Terms()


class CoupledHand:
    """A hand with a tool that rests where forces balance, from one period to the next.

    The tool is at rest at a position (3,) of the device, upright, and has been there for `REST`
    periods. The damper cancels what delay gives, as in a session: B = K (T / 2 + t_d).
    """

    def __init__(
        self, ground: Ground, shell: PointShell, start: Floats, terms: Terms = USUAL
    ) -> None:
        pose = posed(start)
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

    @classmethod
    def above(
        cls, ground: Ground, stand: Stand, across: int, terms: Terms = USUAL
    ) -> "CoupledHand":
        """With a flat tool, `ABOVE` the onset of contact."""
        return cls(ground, flat_tool(across, ground.size, stand.axes), stand.at(-ABOVE), terms)

    def step(self, pose: Floats, velocity: Floats) -> Floats:
        """Force (3,) on the device after one period, N; the caller's own array.

        pose (4, 4) and velocity (6,): of the device, metres of the device.
        """
        self._handle.follow(Reading(pose, velocity, 0), self._hand)
        self._periods.step(self._period, 0)
        return np.array(self._sent["wrench"][:3])

    def lead(self, positions: Floats) -> Floats:
        """Forces (M, 3) along positions (M, 3), one a period of 1 / `RATE` s, upright."""
        velocities = np.zeros((len(positions), 6))
        velocities[1:, :3] = np.diff(positions, axis=0) * RATE
        pairs = zip(positions, velocities, strict=True)
        return np.array([self.step(posed(place), velocity) for place, velocity in pairs])


def straight(start: Floats, end: Floats, speed: float = SPEED) -> Floats:
    """Positions (M, 3) from start to end, both included, at a speed in m/s."""
    way = float(np.linalg.norm(end - start))
    count = max(round(way / speed * RATE), 1)
    return np.asarray(start + np.linspace(0.0, 1.0, count + 1)[:, None] * (end - start))


def ripple(values: ArrayLike) -> float:
    """Standard deviation over mean; infinite for values whose mean is 0 or less."""
    array = np.asarray(values, dtype=np.float64)
    mean = float(array.mean())
    return float(array.std()) / mean if mean > 0.0 else float("inf")


def largest_step(forces: Floats, apart: int = 1) -> float:
    """Greatest change between forces (M, 3) that are at most `apart` samples apart."""
    steps = [
        np.linalg.norm(forces[n:] - forces[:-n], axis=1).max(initial=0.0)
        for n in range(1, min(apart, len(forces) - 1) + 1)
    ]
    return float(max(steps, default=0.0))
