"""Coupling: the tool as a body, and what pulls it to the handle."""

import math
from dataclasses import dataclass

import numpy as np

from hapticdb.errors import UsageError
from hapticdb.kernels.hand.body import Body
from hapticdb.kernels.resident.cells import Place
from hapticdb.pointshell.shell import PointShell


@dataclass(frozen=True)
class Coupling:
    """The tool as a body, and the spring and damper that pull it to the hand.

    The damper is critical, for turns as for moves. The moment of inertia is that of all mass at
    the point farthest from the centre, m r^2, more than any tool of that mass has: a push at any
    lever then moves no point more than twice as easily as one at the centre, so that long tools are
    as stable as round ones. Stiffness and damping of turns are those of moves, times r^2.

    In contact the spring is stretched by half a voxel at most, and the damper pulls no harder than
    that spring, so that the force is `stiffness` times a voxel at most, however fast the hand is
    said to be; likewise for turns. What is sent to the device is about the handle's origin.

    Attributes
    ----------
    mass : float
        kg.
    stiffness : float
        Of the spring, N/m.
    hold, fade : float
        Seconds that the last wrench is kept where cells are unknown, and in which it then falls to
        zero; it rises again within `fade`, in four frames at least, as it does when a session
        starts, and as it falls and rises when the clutch opens and closes.
    most_substeps : int
        Of a period; the rest of a period that needs more is dropped.

    Raises
    ------
    UsageError
        When a number is out of its range.
    """

    mass: float = 0.012
    stiffness: float = 1000.0
    hold: float = 0.02
    fade: float = 0.02
    most_substeps: int = 64

    def __post_init__(self) -> None:
        for name, unit in (("mass", "kg"), ("stiffness", "N/m"), ("hold", "s"), ("fade", "s")):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise UsageError(f"a coupling's {name} of {value} {unit}: give a number above 0")
        if self.most_substeps < 1:
            raise UsageError(f"{self.most_substeps} substeps a period: give 1 or more")

    def body(self, shell: PointShell, place: Place, stiffness: float) -> Body:
        """Body of a shell in a grid, as the kernel takes it; stiffness of a contact, N/m.

        Raises
        ------
        UsageError
            When the stiffness is negative or not finite.
        """
        if not (math.isfinite(stiffness) and stiffness >= 0.0):
            raise UsageError(f"a contact's stiffness of {stiffness} N/m: give 0 or more")
        reach = float(np.linalg.norm(shell.points - shell.center, axis=1).max())
        radius = max(reach, place.size)  # a single point would turn without resistance
        inertia = self.mass * radius**2
        damping = 2.0 * math.sqrt(self.stiffness * self.mass)
        return Body(
            mass=float(self.mass),
            inertia=inertia,
            spring=float(self.stiffness),
            damping=damping,
            turn_spring=self.stiffness * radius**2,
            turn_damping=damping * radius**2,
            radius=radius,
            stiffness=float(stiffness),
            hold=float(self.hold),
            fade=float(self.fade),
            most_substeps=int(self.most_substeps),
        )
