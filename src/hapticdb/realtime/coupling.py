"""Coupling: the tool as a body, and the spring and damper that pull it to the handle."""

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

    Translations and rotations are critically damped. The moment of inertia is m r^2: all mass at
    the point farthest from the centre, more than any tool of that mass has. A push anywhere then
    moves no point more than twice as easily as a push at the centre, so long tools are as stable
    as round ones. Stiffness and damping of rotations are those of translations, times r^2.

    In contact the spring is stretched by half a voxel at most, and the damper pulls no harder than
    that spring. So the force is at most `stiffness` times a voxel, however fast the hand moves;
    the torque is bounded likewise. The torque sent to the device is about the handle's origin.

    Attributes
    ----------
    mass : float
        Mass of the tool, kg.
    stiffness : float
        Stiffness of the spring, N/m.
    hold, fade : float
        In unknown cells the last wrench is kept for `hold` seconds and then falls to zero in `fade`
        seconds. It rises again within `fade`, in at least four frames. It rises in the same way
        when a session starts, and falls and rises when the clutch opens and closes.
    most_substeps : int
        Greatest number of substeps of a period. If a period needs more, its rest is dropped.

    Raises
    ------
    UsageError
        If a number is out of its range.
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
        """Body of a shell in a grid, in the kernel's form; `stiffness` is a contact's, N/m.

        Raises
        ------
        UsageError
            If the stiffness is negative or not finite.
        """
        if not (math.isfinite(stiffness) and stiffness >= 0.0):
            raise UsageError(f"a contact's stiffness of {stiffness} N/m: give 0 or more")
        reach = float(np.linalg.norm(shell.points - shell.center, axis=1).max())
        radius = max(reach, place.size)  # a single point would have no inertia
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
