"""What the options of `feel` say of the force: its law, and the spring between hand and tool."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hapticdb.cli import render
from hapticdb.cli.tools import inset_for
from hapticdb.errors import UsageError

if TYPE_CHECKING:
    from hapticdb.cli.choosing import Felt
    from hapticdb.devices.profiles import DeviceProfile
    from hapticdb.query.law import ForceLaw, LawName
    from hapticdb.realtime.coupling import DeviceCoupling
    from hapticdb.realtime.resident_cells import ResidentCells
    from hapticdb.realtime.session import Session

PLANE_STIFFNESS = 1000.0
"""Stiffness of a contact under the law plane unless --stiffness is given, N/m."""


@dataclass(frozen=True)
class ForceOptions:
    """What the options of `feel` say of the force.

    Attributes
    ----------
    law_name : {"plane", "smooth"} or None
        --law. None: smooth where the environment has distances.
    stiffness : float or None
        --stiffness, N/m: at the device under the smooth law, of a contact under the plane law.
    profile_name : str or None
        --device-profile.
    cap : float or None
        --cap, N.
    delay_ms : float or None
        --delay, milliseconds.
    is_conservative : bool
        --conservative: the tool's points stay on its surface.

    Raises
    ------
    UsageError
        If a number is out of its range, or options contradict one another.
    """

    law_name: "LawName | None"
    stiffness: float | None
    profile_name: str | None
    cap: float | None
    delay_ms: float | None
    is_conservative: bool

    def __post_init__(self) -> None:
        """Refuse what no session takes, before anything is opened."""
        self._device_coupling()
        if self.law_name == "plane":
            self._check_plane()
            self._plane()

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

    def law_and_coupling(self, cells: "ResidentCells") -> dict[str, Any]:
        """Arguments `law` and `coupling` of a session on those cells."""
        if cells.has_distances:
            return {"law": "smooth", "coupling": self._device_coupling()}
        self._check_plane()
        return {"law": self._plane(), "coupling": None}

    def inset(self, cells: "ResidentCells") -> float:
        """How far a tool is drawn inward on those cells, metres; see `inset_for`."""
        law = "smooth" if cells.has_distances else "plane"
        return inset_for(cells.grid.voxel_size, law, is_conservative=self.is_conservative)

    def tell_lowered(self, session: "Session") -> None:
        """Tell in one line by what a stiffness that was asked for is lowered."""
        lowered = getattr(session.coupling, "lowered", None)
        if self.stiffness is not None and lowered is not None:
            render.note(lowered)

    def _device_coupling(self) -> "DeviceCoupling":
        from hapticdb.realtime.coupling import DeviceCoupling

        return DeviceCoupling(
            stiffness=self.stiffness,
            cap=self.cap,
            delay=None if self.delay_ms is None else 1e-3 * self.delay_ms,
            profile=self.profile(),
        )

    def _plane(self) -> "ForceLaw":
        from hapticdb import TangentPlane

        return TangentPlane(PLANE_STIFFNESS if self.stiffness is None else self.stiffness)

    def _check_plane(self) -> None:
        """Refuse options that the plane law does not take."""
        given = {"--cap": self.cap, "--delay": self.delay_ms}
        for option, value in given.items():
            if value is not None:
                raise UsageError(
                    f"{option} belongs to the smooth law, and this session has the plane law: "
                    "leave it out, or use an environment with distances"
                )
