"""The coupling between hand and tool, and direct rendering without one.

The virtual coupling with contact constraints needs distances to surfaces: the tool rests where its
spring and the contacts balance. Rendered directly, the wrench of each frame goes to the device, up
to the device's caps, under either law.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from hapticdb.devices.profiles import DeviceProfile
from hapticdb.devices.stability import limit_stiffness
from hapticdb.errors import UsageError
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import DistanceField, ForceLaw

Rendering = Literal["coupled", "direct"]
RENDERINGS: tuple[Rendering, ...] = get_args(Rendering)
"""How a session renders forces: by the virtual coupling with contact constraints, or each frame's
wrench, up to the device's caps."""
HOLD = FADE = 0.02
"""Seconds. In unknown cells the last wrench stays for `HOLD` and then falls to zero in `FADE`. It
rises again within `FADE`, in at least four frames; likewise when a session starts or the clutch
closes. Larger: a longer gap is bridged, with a possibly wrong force."""
MOST = 1e9
"""Largest number of a `Coupling`, in its unit: more than any device has."""


def limit_text(newtons: float, cap: float) -> str:
    """Words behind a force at the device's cap; rounding keeps it below the cap."""
    return ", at its limit" if newtons >= 0.999 * cap else ""


def rendering_of(rendering: Rendering | None, law: ForceLaw) -> Rendering:
    """Rendering of a session under a law; by default coupled under `DistanceField`."""
    if rendering is None:
        return "coupled" if isinstance(law, DistanceField) else "direct"
    if rendering not in RENDERINGS:
        raise UsageError(f"rendering {rendering!r}: choose one of {', '.join(RENDERINGS)}")
    if rendering == "coupled" and not isinstance(law, DistanceField):
        raise UsageError(
            "the rendering coupled needs the law distance: choose that, or the rendering direct"
        )
    return rendering


@dataclass(frozen=True)
class Coupling:
    """The spring between hand and tool; all in device units.

    The tool has no mass: in each period it rests at the balance of spring and contacts. The
    hand feels the spring, so the force is min(stiffness times depth, cap), for any voxel size,
    number of points and scale. Missing numbers come from the device's profile
    (`hapticdb.devices.profiles`), and the stiffness is lowered to a stable one
    (`hapticdb.devices.stability`).

    The rendering direct has no spring: `cap`, `torque_cap` and `profile` then bound the wrench, and
    the other numbers are refused.

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

    def __post_init__(self) -> None:
        for name, unit in (
            ("stiffness", "N/m"),
            ("cap", "N"),
            ("turn_stiffness", "N m/rad"),
            ("torque_cap", "N m"),
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

    def of_session(
        self,
        rendering: Rendering,
        profile: DeviceProfile,
        rate: float,
        scale: float,
        radius: float,
    ) -> "DirectRendering":
        """Coupling of one session or, rendered directly, its caps; with all numbers.

        profile : the device's own, unless `self.profile` takes its place; rate : frames a second;
        scale : S, metres of the scene for one metre of the device; radius : distance of the tool's
        farthest point from its centre, metres of the scene. Raises `UsageError` if stiffness or
        delay cannot be used, or a number is given that only a spring has.
        """
        if rendering == "direct":
            return self.direct(profile, scale, radius)
        return self.settled(profile, rate, scale, radius)

    def settled(
        self, profile: DeviceProfile, rate: float, scale: float, radius: float
    ) -> "SettledCoupling":
        """Coupling of one session, as of `of_session`."""
        profile = self.profile or profile
        allowed = limit_stiffness(profile, rate, self.stiffness, self.delay)
        # lever of the tool at the device: the stiffness of turns is the device's at every scale
        stiffness, lever = allowed.stiffness, radius / scale
        cap = profile.cap if self.cap is None else self.cap
        # K (T / 2 + t_d): energy from sampling and delay at this stiffness
        damping = stiffness * (0.5 / rate + allowed.delay)
        return SettledCoupling(
            profile=profile.name,
            stiffness=stiffness,
            requested_stiffness=allowed.requested,
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
        )

    def direct(self, profile: DeviceProfile, scale: float, radius: float) -> "DirectRendering":
        """Rendering without a coupling, as of `of_session`."""
        for name in ("stiffness", "turn_stiffness", "damping", "delay"):
            if getattr(self, name) is not None:
                raise UsageError(
                    f"a coupling's {name} does not go with the rendering direct, which has no "
                    "spring: leave it out, or choose the rendering coupled"
                )
        profile = self.profile or profile
        cap = profile.cap if self.cap is None else self.cap
        return DirectRendering(
            profile=profile.name,
            cap=cap,
            torque_cap=_first(self.torque_cap, profile.torque_cap, cap * radius / scale),
            scale=scale,
            radius=radius,
        )


@dataclass(frozen=True, kw_only=True)
class DirectRendering:
    """Rendering without a coupling: the tool is at the hand.

    This is the loop of the paper (section 4, Figure 4). The wrench of each frame goes to the
    device, up to its caps; nothing keeps the tool out of surfaces.

    profile : name of the device's; cap, torque_cap : greatest force, N, and torque about the tool's
    centre, N m, at the device; scale, radius : as for `Coupling.of_session`; hold, fade : `HOLD`.
    """

    profile: str
    cap: float
    torque_cap: float
    scale: float
    radius: float
    hold: float = HOLD
    fade: float = FADE

    def spring(self) -> DeviceSpring:
        """Numbers in the kernel's form, 0 without a spring."""
        numbers = {name: float(getattr(self, name, 0.0)) for name in DeviceSpring._fields}
        return DeviceSpring(**numbers | {"turn_cap": float(self.torque_cap)})


@dataclass(frozen=True, kw_only=True)
class SettledCoupling(DirectRendering):
    """A `Coupling` of one session: every number is settled. A recording has these.

    requested_stiffness : before it was lowered, N/m at the device; lowered : one line on what
    lowered it, None if nothing did; others as for `Coupling`.
    """

    stiffness: float
    requested_stiffness: float
    lowered: str | None
    turn_stiffness: float
    damping: float
    delay: float


def radius_of(shell: PointShell, voxel_size: float) -> float:
    """Distance of the shell's farthest point from its centre, m; a voxel for a single point."""
    reach = float(np.linalg.norm(shell.points - shell.center, axis=1).max())
    return max(reach, voxel_size)


def _first(*values: float | None) -> float:
    """First value except None."""
    return next(value for value in values if value is not None)
