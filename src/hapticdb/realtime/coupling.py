"""Couplings between hand and tool.

`Coupling` is for environments without distances: the tool is a body with a mass, and a spring and a
damper pull it to the handle. `DeviceCoupling` is for environments with distances: the tool has no
mass, and the numbers are those of the device.
"""

import math
from dataclasses import dataclass

import numpy as np

from hapticdb.devices.profiles import DeviceProfile
from hapticdb.devices.stability import allow
from hapticdb.errors import UsageError
from hapticdb.kernels.hand.body import Body
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.resident.cells import Place
from hapticdb.pointshell.shell import PointShell

MOST = 1e9
"""Largest number of a `DeviceCoupling`, in its unit: more than any device has."""


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
        K, stiffness of the spring, N/m at the device.
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

    def body(self, shell: PointShell, place: Place, stiffness: float, scale: float = 1.0) -> Body:
        """Body of a shell in a grid, in the kernel's form; `stiffness` is a contact's, N/m.

        The spring of the body is K / S in the scene, so that a device whose metre is S metres of
        the scene (`scale`) feels K.

        Raises
        ------
        UsageError
            If the stiffness is negative or not finite.
        """
        if not (math.isfinite(stiffness) and stiffness >= 0.0):
            raise UsageError(f"a contact's stiffness of {stiffness} N/m: give 0 or more")
        radius = radius_of(shell, place.size)  # a single point would have no inertia
        inertia = self.mass * radius**2
        spring = self.stiffness / scale
        damping = 2.0 * math.sqrt(spring * self.mass)
        return Body(
            mass=float(self.mass),
            inertia=inertia,
            spring=float(spring),
            damping=damping,
            turn_spring=spring * radius**2,
            turn_damping=damping * radius**2,
            radius=radius,
            stiffness=float(stiffness),
            hold=float(self.hold),
            fade=float(self.fade),
            most_substeps=int(self.most_substeps),
        )


@dataclass(frozen=True)
class DeviceCoupling:
    """The spring between hand and tool where the environment has distances; all in device units.

    The tool has no mass: in each period it rests where the spring and the contacts balance. The
    hand feels the spring, so the force is min(stiffness times depth, cap), whatever the voxel size,
    the number of points and the scale. A number that is not given comes from the device's profile
    (`hapticdb.devices.profiles`), and the stiffness is lowered to what stays stable
    (`hapticdb.devices.stability`).

    Attributes
    ----------
    stiffness : float or None
        K, N/m. None: the profile's.
    cap : float or None
        Greatest force that is sent, N. None: the profile's.
    turn_stiffness : float or None
        N m/rad. None: the profile's; where it has none, K r^2 with the tool's lever r: the distance
        of its farthest point from its centre, in metres of the device.
    torque_cap : float or None
        Greatest torque about the tool's centre that is sent, N m. None: the profile's; where it has
        none, cap times r.
    damping : float or None
        B, N s/m, along the force. None: K (T / 2 + t_d), which takes away the energy that delay
        puts in, and no more than the profile's damping.
    delay : float or None
        t_d, seconds from reading a place until its force acts. None: the device's; where it states
        none, one period of the loop.
    profile : DeviceProfile or None
        Takes the place of the device's own profile.
    hold, fade : float
        As for `Coupling`.

    Raises
    ------
    UsageError
        If a number is out of its range.
    """

    stiffness: float | None = None
    cap: float | None = None
    turn_stiffness: float | None = None
    torque_cap: float | None = None
    damping: float | None = None
    delay: float | None = None
    profile: DeviceProfile | None = None
    hold: float = 0.02
    fade: float = 0.02

    def __post_init__(self) -> None:
        for name, unit in (
            ("stiffness", "N/m"),
            ("cap", "N"),
            ("turn_stiffness", "N m/rad"),
            ("torque_cap", "N m"),
            ("hold", "s"),
            ("fade", "s"),
        ):
            value = getattr(self, name)
            if value is not None and not 0.0 < value <= MOST:
                raise UsageError(
                    f"a coupling's {name} of {value} {unit}: give a number above 0, up to {MOST:g}"
                )
        for name, unit in (("damping", "N s/m"), ("delay", "s")):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0.0):
                raise UsageError(f"a coupling's {name} of {value} {unit}: give 0 or more")

    def settled(
        self, profile: DeviceProfile, rate: float, scale: float, radius: float
    ) -> "SettledCoupling":
        """Coupling of one session, with all its numbers.

        Parameters
        ----------
        profile : DeviceProfile
            The device's own; `self.profile` takes its place if it is given.
        rate : float
            Frames a second.
        scale : float
            S, metres of the scene for one metre of the device.
        radius : float
            Distance of the tool's farthest point from its centre, metres of the scene.

        Raises
        ------
        UsageError
            If the stiffness or the delay cannot be used.
        """
        profile = profile if self.profile is None else self.profile
        allowed = allow(profile, rate, self.stiffness, self.delay)
        stiffness, lever = allowed.stiffness, radius / scale
        cap = profile.cap if self.cap is None else self.cap
        damping = stiffness * (0.5 / rate + allowed.delay)
        return SettledCoupling(
            profile=profile.name,
            stiffness=stiffness,
            asked_stiffness=allowed.asked,
            lowered=allowed.lowered,
            cap=cap,
            turn_stiffness=_first(
                self.turn_stiffness, profile.turn_stiffness, stiffness * lever**2
            ),
            torque_cap=_first(self.torque_cap, profile.torque_cap, cap * lever),
            damping=min(damping, profile.damping) if self.damping is None else self.damping,
            delay=allowed.delay,
            scale=scale,
            radius=radius,
            hold=self.hold,
            fade=self.fade,
        )


@dataclass(frozen=True)
class SettledCoupling:
    """A `DeviceCoupling` of one session: every number is settled. A recording has these.

    Attributes
    ----------
    profile : str
        Name of the device's profile.
    stiffness, asked_stiffness : float
        K, N/m at the device, and the one that was asked for.
    lowered : str or None
        One line: what lowered the stiffness; None if nothing did.
    cap, turn_stiffness, torque_cap, damping, delay, hold, fade : float
        As for `DeviceCoupling`.
    scale : float
        S, metres of the scene for one metre of the device.
    radius : float
        Distance of the tool's farthest point from its centre, metres of the scene.
    """

    profile: str
    stiffness: float
    asked_stiffness: float
    lowered: str | None
    cap: float
    turn_stiffness: float
    torque_cap: float
    damping: float
    delay: float
    scale: float
    radius: float
    hold: float
    fade: float

    def spring(self) -> DeviceSpring:
        """Return the numbers in the kernel's form."""
        return DeviceSpring(
            stiffness=float(self.stiffness),
            turn_stiffness=float(self.turn_stiffness),
            cap=float(self.cap),
            turn_cap=float(self.torque_cap),
            damping=float(self.damping),
            scale=float(self.scale),
            radius=float(self.radius),
            hold=float(self.hold),
            fade=float(self.fade),
        )


def radius_of(shell: PointShell, voxel_size: float) -> float:
    """Distance of the shell's farthest point from its centre, m; a voxel for a single point."""
    reach = float(np.linalg.norm(shell.points - shell.center, axis=1).max())
    return max(reach, voxel_size)


def _first(*values: float | None) -> float:
    """Return the first value that is not None."""
    return next(value for value in values if value is not None)


def coupling_for(
    coupling: Coupling | DeviceCoupling | None, *, smooth: bool
) -> Coupling | DeviceCoupling:
    """Coupling for a law: the given one if it fits, the law's own if none is given.

    Raises
    ------
    UsageError
        If the coupling belongs to the other law.
    """
    wanted = DeviceCoupling if smooth else Coupling
    if coupling is None:
        return wanted()
    if not isinstance(coupling, wanted):
        law = "smooth law" if smooth else "tangent plane"
        raise UsageError(
            f"a {type(coupling).__name__} does not go with the {law}: give a {wanted.__name__}"
        )
    return coupling
