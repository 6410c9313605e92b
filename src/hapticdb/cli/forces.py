"""What the options of `feel` say of the force: its law, and the coupling of hand and tool."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hapticdb.cli import render
from hapticdb.errors import UsageError

if TYPE_CHECKING:
    from hapticdb.cli.choosing import Felt
    from hapticdb.devices.profiles import DeviceProfile
    from hapticdb.query.law import ForceLaw, LawName
    from hapticdb.realtime.coupling import Coupling
    from hapticdb.realtime.resident_cells import ResidentCells
    from hapticdb.realtime.session import Session

PLANE_STIFFNESS = 1000.0
"""Stiffness of a contact under the law plane unless --stiffness is given, N/m."""


@dataclass(frozen=True)
class ForceOptions:
    """What the options of `feel` say of the force; a UsageError where they contradict.

    stiffness : N/m, at the device under the smooth law, of a contact under the plane law; cap : N;
    delay_ms : milliseconds; is_conservative : the tool's points stay on its surface.
    """

    law_name: "LawName | None"
    stiffness: float | None
    profile_name: str | None
    cap: float | None
    delay_ms: float | None
    is_conservative: bool

    def __post_init__(self) -> None:
        """Refuse what no session takes, before anything is opened."""
        self._law_and_coupling()

    def profile(self) -> "DeviceProfile | None":
        """Profile that --device-profile names; None where it is not given."""
        from hapticdb.devices.profiles import profile_named

        return None if self.profile_name is None else profile_named(self.profile_name)

    def cells(self, url: str, budget_bytes: int, felt: "Felt") -> "ResidentCells":
        """Resident cells for a session; they have distances where the law reads them."""
        from hapticdb import ResidentCells

        distances = None if self.law_name is None else self.law_name == "smooth"
        return ResidentCells(
            url, budget_bytes=budget_bytes, where=felt.where, exclude=felt.exclude,
            distances=distances,
        )  # fmt: skip

    def law_and_coupling(self, cells: "ResidentCells") -> "tuple[ForceLaw | None, Coupling]":
        """Law and coupling; a UsageError if no law was asked for and cells have no distances."""
        from hapticdb.realtime.resident_cells import without_distances

        if self.law_name is None and not cells.has_distances:
            raise UsageError(without_distances(cells.url))
        return self._law_and_coupling()

    def inset(self, voxel_size: float) -> float:
        """How far a tool is drawn inward among voxels of that size; metres."""
        from hapticdb.query.law import inset_of

        law = self.law_name or "smooth"
        return 0.0 if self.is_conservative else inset_of(voxel_size, law)

    def tell_lowered(self, session: "Session") -> None:
        """Tell in one line by what a stiffness that was asked for is lowered."""
        lowered = getattr(session.coupling, "lowered", None)
        if self.stiffness is not None and lowered is not None:
            render.note(lowered)

    def _law_and_coupling(self) -> "tuple[ForceLaw | None, Coupling]":
        from hapticdb import TangentPlane
        from hapticdb.realtime.coupling import Coupling

        if self.law_name != "plane":
            delay = None if self.delay_ms is None else 1e-3 * self.delay_ms
            return None, Coupling(self.stiffness, self.cap, delay=delay, profile=self.profile())
        if self.delay_ms is not None:
            raise UsageError("--delay belongs to the smooth law: under the plane law leave it out")
        stiffness = PLANE_STIFFNESS if self.stiffness is None else self.stiffness
        return TangentPlane(stiffness), Coupling(cap=self.cap, profile=self.profile())
