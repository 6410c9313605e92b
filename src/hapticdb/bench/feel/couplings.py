"""Sessions under both laws behind one interface, period by period in this process.

No loop, no clock and no device: a measure gives the hand's place and reads the force.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hapticdb.bench.feel.ground import Ground
from hapticdb.devices.protocol import Reading
from hapticdb.kernels.field.law import ONSET
from hapticdb.kernels.hand import direct, quasistatic
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.hand.near_points import FIELD_ROWS, MET_ROWS
from hapticdb.kernels.records import (
    FOLLOWER,
    MOST_MISSED,
    RESULTS,
    SERVO,
    pose_numbers,
    views_of,
)
from hapticdb.kernels.resident.feeling import feel_kernel
from hapticdb.kernels.rigid import poses_of
from hapticdb.pointshell.shell import PointShell
from hapticdb.poses import rotation_of
from hapticdb.query.law import DistanceField, ForceLaw, TangentPlane
from hapticdb.realtime.handle import Handle
from hapticdb.resident.frames import clusters_of

Floats = NDArray[np.float64]

STIFFNESS = 1000.0
"""Stiffness at the device, N/m, where a measure names no other."""
RATE = 1000.0
"""Periods a second, where a measure names no other."""
CAP = 20.0
"""Most force of the device, N: above all that is wanted of it here. Larger: stiffer
contacts in its coupling."""
REST = 40
"""Periods that a tool rests at its first place: a session's force rises within 20 ms. Larger: a
session at a higher rate has risen, too; each measure takes longer."""


@dataclass(frozen=True)
class Terms:
    """Terms of a session.

    stiffness, N/m, at the device; rate: periods a second; delay: seconds from sending a force until
    it acts; scale: metres of the scene for one metre of the device.
    """

    stiffness: float = STIFFNESS
    rate: float = RATE
    delay: float = 0.0
    scale: float = 1.0


class Hand(Protocol):
    """A hand that holds a tool in a scene, from one period to the next."""

    def step(self, pose: Floats, velocity: Floats) -> Floats:
        """Force (3,) on the device after one period, N.

        pose (4, 4) and velocity (6,): of the device, metres of the device; the array that is
        returned is the caller's own.
        """

    @property
    def tool(self) -> Floats:
        """Position (3,) of the tool, metres of the scene."""

    def placed(self, points: Floats) -> Floats:
        """Points (N, 3) of the tool's frame where the tool is, metres of the scene."""


Grasp = Callable[[Ground, PointShell, Floats, Terms], Hand]
"""Puts a hand with a tool at a pose (4, 4) of the device: ground, tool, pose, terms -> hand."""


class _Held:
    """A tool in a hand: what both laws keep, and how they begin."""

    def __init__(self, ground: Ground, shell: PointShell, pose: Floats, terms: Terms) -> None:
        self._cells, self._place = ground.table.cells, ground.residency.place
        self._row = 0
        self._clusters = clusters_of(shell, ground.size)
        self._servo = np.zeros((), SERVO)
        views = views_of(self._servo)
        self._tool, self._hand, self._sent = views.tool, self._servo["hand"], views.sent
        self._met = np.zeros((MET_ROWS, len(shell)), dtype=np.int64)
        self._missed = np.zeros(1 + MOST_MISSED, dtype=np.int64)
        self._handle = Handle(scale=terms.scale)
        self._period = 1.0 / terms.rate
        self._handle.start(Reading(pose, np.zeros(6), 0), self._hand)
        self._tool.position[:] = self._hand["position"]
        self._tool.quaternion[:] = self._hand["quaternion"]

    def _advance(self) -> None:
        """Run one period."""
        raise NotImplementedError

    def _rest(self, pose: Floats) -> None:
        """Stay at the first pose for `REST` periods at 1 kHz."""
        for _ in range(round(REST / (self._period * RATE))):
            self.step(pose, np.zeros(6))

    def step(self, pose: Floats, velocity: Floats) -> Floats:
        """Force (3,) on the device after one period; see `Hand`."""
        self._handle.follow(Reading(pose, velocity, 0), self._hand)
        self._advance()
        return np.array(self._sent.wrench[:3])

    @property
    def tool(self) -> Floats:
        """Position (3,) of the tool, metres of the scene."""
        return np.array(self._tool.position)

    def placed(self, points: Floats) -> Floats:
        """Points (N, 3) of the tool's frame where the tool is, metres of the scene."""
        rotation = rotation_of(self._tool.quaternion)[0]
        return np.asarray(points @ rotation.T + self._tool.position)


class PlaneHand(_Held):
    """The tangent plane, rendered directly: the tool is at the hand.

    The tool is at rest at the pose, and has been there for `REST` periods.
    """

    def __init__(self, ground: Ground, shell: PointShell, pose: Floats, terms: Terms) -> None:
        super().__init__(ground, shell, pose, terms)
        self._cells = self._cells.without_distances()
        self._law = TangentPlane(terms.stiffness).for_kernels
        self._terms = direct.DirectTerms(CAP, CAP, terms.scale, 0.02, 0.02)
        self._poses, self._felt = np.empty((1, 4, 4)), np.zeros((1, RESULTS))
        self._rest(pose)

    def _advance(self) -> None:
        poses_of(pose_numbers(self._hand)[None], self._poses)
        feel_kernel(
            self._cells, self._row, self._clusters, self._poses, self._place, self._law,
            self._met[0], self._missed, self._felt,
        )  # fmt: skip
        direct.render(
            self._terms, self._clusters.center, self._servo, self._felt, 0, self._period
        )  # fmt: skip


class SmoothHand(_Held):
    """The distance law with the quasi-static coupling: a tool that rests where forces balance.

    Parameters and methods are those of `PlaneHand`. The damper cancels what delay gives, as in a
    session: B = K (T / 2 + t_d).
    """

    def __init__(self, ground: Ground, shell: PointShell, pose: Floats, terms: Terms) -> None:
        super().__init__(ground, shell, pose, terms)
        reach = float(np.linalg.norm(shell.points - shell.center, axis=1).max())
        lever = max(reach, ground.size) / terms.scale
        self._spring = DeviceSpring(
            stiffness=terms.stiffness,
            turn_stiffness=terms.stiffness * lever**2,
            cap=CAP,
            turn_cap=CAP * lever,
            damping=terms.stiffness * (0.5 / terms.rate + terms.delay),
            scale=terms.scale,
            radius=reach,
            hold=0.02,
            fade=0.02,
        )
        self._follower = np.zeros((), FOLLOWER)
        self._field = np.zeros((FIELD_ROWS, len(shell)))
        self._rest(pose)

    def _advance(self) -> None:
        quasistatic.advance(
            self._cells, self._row, self._clusters, self._place, self._spring, self._servo,
            self._follower, self._period, self._field, self._met, self._missed,
        )  # fmt: skip


@dataclass(frozen=True)
class Side:
    """One side of the comparison.

    law : ``plane`` or ``smooth``, as for `Environment.touch`; onset : voxels before the surface at
    which contact begins; grasp : makes its hand; distances : whether its environments hold them.
    """

    law: str
    onset: float
    grasp: Grasp
    distances: bool

    def law_of(self, stiffness: float) -> ForceLaw:
        """The law of this side for `touch`, with a stiffness in N/m."""
        return DistanceField(stiffness) if self.distances else TangentPlane(stiffness)


PLANE = Side("plane", 0.0, PlaneHand, distances=False)
SMOOTH = Side("smooth", ONSET, SmoothHand, distances=True)
SIDES = (PLANE, SMOOTH)
"""Both laws: the columns of the table."""


class Drive(NamedTuple):
    """A hand's way: positions (M, 3) of the device, forces (M, 3) on it, and tools (M, 3)."""

    positions: Floats
    forces: Floats
    tools: Floats


def posed(position: Floats, rotation: Floats | None = None) -> Floats:
    """Pose (4, 4) at a position (3,), upright unless a rotation (3, 3) is given."""
    pose = np.eye(4)
    pose[:3, 3] = position
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose


def drive(hand: Hand, positions: Floats, rate: float = RATE) -> Drive:
    """Lead a hand along positions (M, 3), one a period, upright."""
    velocities = np.zeros((len(positions), 6))
    velocities[1:, :3] = np.diff(positions, axis=0) * rate
    forces, tools = np.empty_like(positions), np.empty_like(positions)
    pose = np.eye(4)
    for n, (position, velocity) in enumerate(zip(positions, velocities, strict=True)):
        pose[:3, 3] = position
        forces[n] = hand.step(pose, velocity)
        tools[n] = hand.tool
    return Drive(positions, forces, tools)


def straight(start: Floats, end: Floats, speed: float, rate: float = RATE) -> Floats:
    """Positions (M, 3) from start to end, both included, at a speed in m/s."""
    way = float(np.linalg.norm(end - start))
    count = max(round(way / speed * rate), 1)
    return np.asarray(start + np.linspace(0.0, 1.0, count + 1)[:, None] * (end - start))


def chained(pieces: Iterator[Floats] | list[Floats]) -> Floats:
    """Positions of pieces after one another, each beginning where the last ends."""
    first, *others = pieces
    return np.concatenate([first, *(piece[1:] for piece in others)])
