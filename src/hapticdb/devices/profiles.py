"""Device profiles: what a device can render, and how heavy it is; by its name.

A profile states the force that a device can hold, the stiffest spring and the strongest damper that
it renders cleanly, and its mass, as far as they are known. `hapticdb.devices.stability` computes
from it how stiff a session may be.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from hapticdb.errors import UsageError

LIGHTEST = 0.045
"""Mass, kg, that is assumed where a device's mass is not known: that of the lightest device of the
table. Larger: stiffer springs are allowed on devices whose mass nobody told, with more risk."""
HAND_CAP = 7.0
"""Cap, N, of hands that are not real (scripted and simulated ones): that of a desktop device.
Larger: their sessions reach deeper, with forces that no desktop device can hold."""
HAND_STIFFNESS = 1000.0
"""Stiffness, N/m, of a session with a hand that is not real, unless another is asked for."""
STIFFEST = 1e6
"""Greatest stiffness, N/m, that any profile has: stiffer than a device can render."""


@dataclass(frozen=True)
class DeviceProfile:
    """What a device renders, in its own metres and newtons.

    Attributes
    ----------
    name : str
        The device's name, for messages.
    cap : float
        Greatest force that its motors hold, N.
    stiffness : float
        Stiffest spring that it renders, N/m.
    damping : float
        Strongest damper that it renders, N s/m: a damper that the loop commands, not friction of
        the device's own.
    mass : float or None
        Mass that a hand feels at its tip, kg. None: not known.
    own_damping : float
        Damping of the device's own mechanics, N s/m. 0: not known.
    hand_damping : float or None
        Damping of the hand that holds the device, N s/m. None: a person's, who holds it lightly.
        Infinite: no force moves this hand, so any spring is stable.
    usual_stiffness : float or None
        Stiffness of a session unless another is asked for, N/m. None: `stiffness`.
    torque_cap : float or None
        Greatest torque of its motors, N m. None: not known; see `hapticdb.session.coupling`.
    turn_stiffness : float or None
        Stiffest spring of turns, N m/rad. None: not known.
    delay : float or None
        Seconds from reading a place until the force that answers it acts, without the period of
        the loop. None: not known.

    Raises
    ------
    UsageError
        If a number is out of its range.
    """

    name: str
    cap: float
    stiffness: float
    damping: float
    mass: float | None = None
    own_damping: float = 0.0
    hand_damping: float | None = None
    usual_stiffness: float | None = None
    torque_cap: float | None = None
    turn_stiffness: float | None = None
    delay: float | None = None

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
        """Stiffness of a session unless another is asked for, N/m."""
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
"""Profiles of devices that can be bought, by their names."""
UNKNOWN = DeviceProfile("unknown", HAND_CAP, 1000.0, 5.0)
"""Profile of a device that states none: what most desktop devices render."""
SCRIPTED = DeviceProfile(
    "scripted",
    HAND_CAP,
    STIFFEST,
    STIFFEST,
    hand_damping=math.inf,
    usual_stiffness=HAND_STIFFNESS,
    delay=0.0,
)
"""Profile of a hand that follows a script: no force moves it."""


@runtime_checkable
class _SupportsProfile(Protocol):
    """A device that knows its profile, before it is opened."""

    @property
    def profile(self) -> DeviceProfile:
        """What the device can render."""


def profile_of(device: object) -> DeviceProfile:
    """Profile of a device; `UNKNOWN` where the device states none.

    Raises
    ------
    UsageError
        If the device's profile is no `DeviceProfile`.
    """
    if not isinstance(device, _SupportsProfile):
        return UNKNOWN
    profile = device.profile
    if not isinstance(profile, DeviceProfile):
        raise UsageError(
            f"{type(device).__name__}.profile is of the type {type(profile).__name__}; "
            "give a hapticdb.devices.profiles.DeviceProfile"
        )
    return profile


def profile_named(name: str) -> DeviceProfile:
    """Profile of a device by its name; capitals and spaces do not matter.

    Raises
    ------
    UsageError
        If no device of the table has that name.
    """
    word = "-".join(name.lower().split())
    if word not in PROFILES:
        raise UsageError(f"no device profile {name!r}: give {', '.join(PROFILES)}")
    return PROFILES[word]
