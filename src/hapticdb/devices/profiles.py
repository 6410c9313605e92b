"""Device profiles by name: rendering limits and mass of a device.

A profile states the greatest force, the stiffest spring and the strongest damper that a device
renders cleanly, and its mass, as far as published. `hapticdb.devices.stability` computes the stable
stiffness of a session from it.
"""

import math
from dataclasses import dataclass

from hapticdb.errors import UsageError

LIGHTEST = 0.045
"""Mass, kg, assumed for a device of unknown mass: that of the lightest device of the table."""
HAND_CAP = 7.0
"""Cap, N, of scripted and simulated hands: that of a desktop device."""
HAND_STIFFNESS = 1000.0
"""Default stiffness, N/m, of a session with a scripted or simulated hand."""
STIFFEST = 1e6
"""Greatest stiffness, N/m, of any profile: stiffer than a device can render."""


@dataclass(frozen=True)
class DeviceProfile:
    """Rendering limits of a device, in its own metres and newtons; None: not known.

    Raises `UsageError` if a number is out of its range.
    """

    name: str
    cap: float
    """Greatest force of its motors, N."""
    stiffness: float
    """Stiffest rendered spring, N/m."""
    damping: float
    """Strongest rendered damper, N s/m: by the loop, without the device's own friction."""
    mass: float | None = None
    """Apparent mass at its tip, kg."""
    own_damping: float = 0.0
    """Damping of its own mechanics, N s/m; 0 if not known."""
    hand_damping: float | None = None
    """Damping of the hand, N s/m; None for a person's light grip, infinite for a scripted hand."""
    usual_stiffness: float | None = None
    """Default stiffness of a session, N/m; None for `stiffness`."""
    torque_cap: float | None = None
    """Greatest torque of its motors, N m; see `hapticdb.session.coupling`."""
    turn_stiffness: float | None = None
    """Stiffest rotational spring, N m/rad."""
    delay: float | None = None
    """Seconds from reading a pose until its force acts, without the period of the loop."""

    def __post_init__(self) -> None:
        above = ("cap", "stiffness", "mass", "usual_stiffness", "torque_cap", "turn_stiffness")
        for field in above:
            value = getattr(self, field)
            if value is not None and not 0.0 < value <= STIFFEST:
                raise UsageError(
                    f"profile {self.name}: {field} {value}: give a number above 0, "
                    f"{STIFFEST:g} at most"
                )
        for field in ("damping", "own_damping", "hand_damping", "delay"):
            value = getattr(self, field)
            is_endless = field == "hand_damping" and value == math.inf
            if value is not None and not (0.0 <= value < math.inf or is_endless):
                raise UsageError(f"profile {self.name}: {field} {value}: give 0 or more")

    @property
    def first_stiffness(self) -> float:
        """Default stiffness of a session, N/m."""
        return self.stiffness if self.usual_stiffness is None else self.usual_stiffness


PROFILES = {
    profile.name: profile
    for profile in (
        # caps, springs and dampers: the recommended greatest values in CHAI3D's sources; masses:
        # data sheets of 3D Systems. The other makers' data sheets give none.
        DeviceProfile("touch", 3.3, 400.0, 4.0, mass=0.045),
        DeviceProfile("omni", 3.3, 700.0, 5.0, mass=0.045),
        DeviceProfile("desktop", 7.9, 1000.0, 5.0, mass=0.045),
        DeviceProfile("premium-1.5", 8.5, 800.0, 5.0, mass=0.075),
        DeviceProfile("falcon", 8.0, 3000.0, 20.0),
        DeviceProfile("omega", 12.0, 5000.0, 30.0),
        DeviceProfile("delta", 20.0, 5000.0, 30.0),
        DeviceProfile("sigma.7", 12.0, 4000.0, 30.0),
    )
}
"""Profiles of commercial devices, by name."""
UNKNOWN = DeviceProfile("unknown", HAND_CAP, 1000.0, 5.0)
"""Profile of a device without one: common limits of desktop devices."""
SCRIPTED = DeviceProfile(
    "scripted", HAND_CAP, STIFFEST, STIFFEST, hand_damping=math.inf,
    usual_stiffness=HAND_STIFFNESS, delay=0.0,
)  # fmt: skip
"""Profile of a scripted hand: no force moves it."""


def profile_of(device: object) -> DeviceProfile:
    """Profile of a device; `UNKNOWN` without one; UsageError unless it is a `DeviceProfile`."""
    profile = getattr(device, "profile", UNKNOWN)  # known before the device is opened
    if not isinstance(profile, DeviceProfile):
        raise UsageError(
            f"{type(device).__name__}.profile is of the type {type(profile).__name__}; "
            "give a hapticdb.devices.profiles.DeviceProfile"
        )
    return profile


def profile_named(name: str) -> DeviceProfile:
    """Profile by the name of a device, in any case; UsageError for an unknown one."""
    word = "-".join(name.lower().split())
    if word not in PROFILES:
        raise UsageError(f"no device profile {name!r}: give {', '.join(PROFILES)}")
    return PROFILES[word]
