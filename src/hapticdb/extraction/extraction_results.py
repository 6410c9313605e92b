"""Results of a search for a removal path, in metres and displacements."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from hapticdb.array_types import Floats
from hapticdb.exact.swept import Swept
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object
from hapticdb.units import notebook_html
from hapticdb.verdicts import PathVerdict

How = Literal["pull", "screw", "plan"]


def ids_of(parts: Sequence[Object]) -> tuple[int, ...]:
    """Ids of parts, in their order."""
    return tuple(obj.id for obj in parts)


class Blocker(NamedTuple):
    """An object in the way; pulls : number of straight pulls it stops."""

    object: Object
    pulls: int


@dataclass(frozen=True, eq=False)
class RemovalPath:
    """A removal path, with the sweep that judges it.

    Attributes
    ----------
    poses : (M, 4, 4) float64
        Displacements of the parts, world frame; the first is the identity.
    how : {'pull', 'screw', 'plan'}
        One straight pull, a screw motion, or a planned path.
    swept : Swept
        Sweep of the whole path.
    """

    poses: Floats
    how: How
    swept: Swept

    @property
    def verdict(self) -> PathVerdict:
        """Proved result; NOT_DECIDED for a refuted path."""
        if self.swept.verdict is PathVerdict.OVERLAPS:
            return PathVerdict.OVERLAPS
        if self.swept.comes_out:
            return PathVerdict.COMES_OUT
        return PathVerdict.SLIDES if self.swept.is_free else PathVerdict.NOT_DECIDED

    @property
    def obstacles(self) -> tuple[Object, ...]:
        """Objects that refute the path, the first one first: enclosed or hit."""
        return (*self.swept.enclosed, *(one.object for one in self.swept.hits))

    @property
    def free_share(self) -> float:
        """Share of the path's motion before the first hit, proved free."""
        if self.swept.enclosed or self.swept.is_stopped:
            return 0.0
        return min((one.fraction for one in self.swept.hits), default=1.0)

    @property
    def length(self) -> float:
        """Metres: upper bound of the motion of any point."""
        return self.swept.path.length

    @property
    def gap(self) -> float | None:
        """Proved distance of the surfaces outside contacts, metres; None without a free path."""
        return self.swept.gap.at_least if self.swept.is_free else None


@dataclass(frozen=True, eq=False)
class Extraction:
    """Result of a search.

    Attributes
    ----------
    parts : tuple of Object
        The parts, as one rigid body.
    shell : PointShell
        Their surface, world frame, and the points of the search.
    to : (4, 4) float64 or None
        Goal displacement; None: out.
    path : RemovalPath or None
        The best path.
    near : tuple of Object
        Objects within about a voxel of the parts at the start.
    blockers : tuple of Blocker
        Objects that stop straight pulls, most pulls first.
    pulls, motions : int
        Straight pulls tried; motion queries of the planner.
    poses : int
        Poses checked.
    is_planned : bool
        Whether the planner was used.
    is_out_of_time : bool
        Whether the deadline ended the search before a path.
    seconds : float
        Time of the search with its proofs.
    seed : int
    """

    parts: tuple[Object, ...]
    shell: PointShell
    to: Floats | None
    path: RemovalPath | None
    near: tuple[Object, ...]
    blockers: tuple[Blocker, ...]
    pulls: int
    motions: int
    poses: int
    is_planned: bool
    is_out_of_time: bool
    seconds: float
    seed: int

    def __repr__(self) -> str:
        how = self.verdict if self.path is None else f"{self.verdict}, by a {self.path.how}"
        names = ", ".join(part.name for part in self.parts[:3])
        return f"Extraction({names}: {how}, pulls tried: {self.pulls}, {self.seconds:.2f} s)"

    def _repr_html_(self) -> str:
        """Objects in the way of the path and of straight pulls, for notebooks."""
        obstacles = () if self.path is None else self.path.obstacles
        rows = [*((obj.name, "in the way") for obj in obstacles)]
        rows += [(one.object.name, f"stops {one.pulls} pulls") for one in self.blockers]
        return notebook_html(self, rows)

    @property
    def verdict(self) -> PathVerdict:
        """Verdict of the path; without one NO_PATH, or NOT_DECIDED at the deadline.

        NO_PATH is no proof of the absence of a path.
        """
        if self.path is not None:
            return self.path.verdict
        return PathVerdict.NOT_DECIDED if self.is_out_of_time else PathVerdict.NO_PATH

    @property
    def is_free(self) -> bool:
        """Whether a path without hits is proved."""
        return self.path is not None and self.path.swept.is_free
