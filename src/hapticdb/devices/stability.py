"""Stable stiffness of a virtual spring on a device.

A sampled spring returns more energy than was put in: its force is late, by half a period on average
and by the delay of device and transfer. Only the damping of the device and of the hand dissipates
this energy (Gil, Sanchez, Hulin, Preusche and Hirzinger 2009).
"""

import math
from dataclasses import dataclass

from hapticdb.devices.profiles import LIGHTEST, DeviceProfile
from hapticdb.errors import UsageError

SHARE = 0.4
"""Used share of the bound of Gil and others. Measured limits were 0.42 to 0.60 of the bound for a
light grip and 0.88 to 1.02 for a firm one."""
SMALLEST = 1.0
"""Least stiffness of a session, N/m: a softer one is imperceptible."""


@dataclass(frozen=True)
class _Allowance:
    """Requested and granted stiffness of a session, N/m; delay in the stability rule, s.

    lowered : one line on the limit that lowered the stiffness; None if none did.
    """

    requested: float
    stiffness: float
    delay: float
    lowered: str | None


def hand_damping(profile: DeviceProfile) -> float:
    """Damping of the hand on the device, N s/m.

    That of a light grip, b = 0.6 sqrt(100 m), 0.3 of critical, unless the profile states it. For an
    unknown mass m, the lightest device's is assumed.
    """
    if profile.hand_damping is not None:
        return profile.hand_damping
    mass = LIGHTEST if profile.mass is None else profile.mass
    return 0.6 * math.sqrt(100.0 * mass)


def delay_of(profile: DeviceProfile, rate: float, delay: float | None = None) -> float:
    """Delay in seconds: the given one, else the device's, else one period of the loop."""
    if delay is not None:
        return delay
    return 1.0 / rate if profile.delay is None else profile.delay


def stable_stiffness(profile: DeviceProfile, rate: float, delay: float) -> float:
    """Greatest stiffness, N/m, stable in a light grip; infinite for a scripted hand.

    K = 0.4 (b + b_hand) / (T / 2 + t_d), with the period T = 1 / rate and the delay t_d, seconds.
    """
    return SHARE * (profile.own_damping + hand_damping(profile)) / (0.5 / rate + delay)


def limit_stiffness(
    profile: DeviceProfile, rate: float, requested: float | None = None, delay: float | None = None
) -> _Allowance:
    """Limit a stiffness to the device's greatest and to the stable one.

    rate : frames a second; requested : N/m at the device, None for the profile's; delay : as for
    `delay_of`. UsageError unless the stiffness is a number of `SMALLEST` or more.
    """
    wanted = profile.first_stiffness if requested is None else requested
    if not (math.isfinite(wanted) and wanted >= SMALLEST):
        raise UsageError(f"a stiffness of {wanted} N/m: give {SMALLEST:g} or more")
    late = delay_of(profile, rate, delay)
    stable = stable_stiffness(profile, rate, late)
    given = max(min(wanted, profile.stiffness, stable), SMALLEST)
    lowered = None
    if given < wanted:
        what = f"stiffness {wanted:.4g} N/m lowered to {given:.4g} N/m: "
        lowered = what + (
            f"the most that the profile {profile.name} allows"
            if profile.stiffness <= stable
            else _stable_text(profile, rate, late)
        )
    return _Allowance(wanted, given, late, lowered)


def _stable_text(profile: DeviceProfile, rate: float, delay: float) -> str:
    """Clause of a message: conditions of the stable stiffness."""
    grip, mass = "", ""
    if profile.hand_damping is None:
        grip = " in a light grip"
        if profile.mass is None:
            mass = f" (mass not known: {LIGHTEST:g} kg assumed)"
    hertz = f"{rate / 1e3:.4g} kHz" if rate >= 1e3 else f"{rate:.4g} Hz"
    return (
        f"at {hertz} and {1e3 * delay:.3g} ms of delay the device {profile.name}{mass} "
        f"stays stable up to that{grip}; a higher rate or a shorter delay allows more"
    )
