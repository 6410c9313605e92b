"""The force that the options of `feel` ask for."""

from typing import TYPE_CHECKING

from hapticdb.errors import UsageError

if TYPE_CHECKING:
    from hapticdb.devices.profiles import DeviceProfile
    from hapticdb.query.law import ForceLaw, LawName
    from hapticdb.realtime.coupling import Coupling

PLANE_STIFFNESS = 1000.0
"""Stiffness of a contact under the law plane unless --stiffness is given, N/m."""


def law_and_coupling(
    law_name: "LawName | None",
    stiffness: float | None,
    cap: float | None,
    delay_ms: float | None,
    profile: "DeviceProfile | None",
) -> "tuple[ForceLaw | None, Coupling]":
    """Law and coupling of a session; a UsageError where options contradict.

    stiffness : N/m, at the device under the smooth law, of a contact under the plane law; cap : N;
    delay_ms : milliseconds.
    """
    from hapticdb import TangentPlane
    from hapticdb.realtime.coupling import Coupling

    if law_name != "plane":
        delay = None if delay_ms is None else 1e-3 * delay_ms
        return None, Coupling(stiffness, cap, delay=delay, profile=profile)
    if delay_ms is not None:
        raise UsageError("--delay belongs to the smooth law: under the plane law leave it out")
    stiffness = PLANE_STIFFNESS if stiffness is None else stiffness
    return TangentPlane(stiffness), Coupling(cap=cap, profile=profile)
