"""The force that the options of `feel` ask for."""

from typing import TYPE_CHECKING

from hapticdb.errors import UsageError

if TYPE_CHECKING:
    from hapticdb.devices.profiles import DeviceProfile
    from hapticdb.query.law import ForceLaw, LawName
    from hapticdb.session.coupling import Coupling, Rendering

CONTACT_STIFFNESS = 1000.0
"""Stiffness of a contact, rendered directly, unless --stiffness is given, N/m."""


def law_and_coupling(
    law_name: "LawName | None",
    rendering: "Rendering",
    stiffness: float | None,
    cap: float | None,
    delay_ms: float | None,
    profile: "DeviceProfile | None",
) -> "tuple[ForceLaw | None, Coupling]":
    """Law and coupling of a session; a UsageError where options contradict.

    stiffness : N/m, at the device if it is coupled, else of a contact; cap : N; delay_ms :
    milliseconds.
    """
    from hapticdb import DistanceField, TangentPlane
    from hapticdb.session.coupling import Coupling

    if rendering == "coupled":
        delay = None if delay_ms is None else 1e-3 * delay_ms
        return None, Coupling(stiffness, cap, delay=delay, profile=profile)
    if delay_ms is not None:
        raise UsageError("--delay belongs to --rendering coupled: leave it out")
    stiffness = CONTACT_STIFFNESS if stiffness is None else stiffness
    law = TangentPlane(stiffness) if law_name == "plane" else DistanceField(stiffness)
    return law, Coupling(cap=cap, profile=profile)
