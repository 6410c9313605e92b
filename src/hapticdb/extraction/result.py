"""Results of a search for a way out, in metres and displacements."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object
from hapticdb.sweeps.result import Swept

Floats = NDArray[np.float64]

WayOutVerdict = Literal["comes out", "comes out of contact", "not decided", "no way found"]


class Blocker(NamedTuple):
    """An object in the way: pulls : number of the straight pulls that it stops."""

    object: Object
    pulls: int


@dataclass(frozen=True, eq=False)
class WayOut:
    """A path on which the parts leave, with what sweeps prove about it.

    Attributes
    ----------
    poses : (M, 4, 4) float64
        Displacements of the parts, world frame; the first is the identity.
    how : {'pull', 'plan'}
        Whether it is one straight pull, or the planner found it.
    swept : Swept
        Sweep of the whole path.
    rest : Swept or None
        If the parts only leave what they touch at their start: the sweep of the path after that.
    rest_from : float
        Metres of the path's motion before `rest` begins; 0 without it.
    """

    poses: Floats
    how: Literal["pull", "plan"]
    swept: Swept
    rest: Swept | None
    rest_from: float

    @property
    def verdict(self) -> WayOutVerdict:
        """What is proved.

        "comes out": the parts meet nothing on the whole path. "comes out of contact": at the start
        they touch objects, which they leave; from `rest_from` on they meet nothing. Voxels do not
        tell whether they slide along what they touch or cut into it. "not decided": neither.
        """
        if self.swept.comes_out:
            return "comes out"
        if self.rest is not None and self.rest.comes_out:
            return "comes out of contact"
        return "not decided"

    @property
    def in_way(self) -> tuple[Object, ...]:
        """Objects that refute the path: it hits them, and not only by leaving them at its start."""
        if self.verdict != "not decided":
            return ()
        return tuple(one.object for one in self.swept.objects if not one.is_left_at_once)

    @property
    def length(self) -> float:
        """Metres that the farthest-moving point moves at most."""
        return float(self.swept.path.motion.sum())

    @property
    def clearance(self) -> float | None:
        """Proved distance of the surfaces where nothing is touched, metres; None if none is."""
        judged = self.swept if self.swept.comes_out else self.rest
        if judged is None or not judged.comes_out or judged.clearance is None:
            return None
        return judged.clearance.at_least


@dataclass(frozen=True, eq=False)
class Extraction:
    """Result of a search.

    Attributes
    ----------
    parts : tuple of Object
        What was to come out, as one rigid body.
    shell : PointShell
        Its points, dense, world frame.
    way : WayOut or None
        The best path found.
    touched : tuple of Object
        Objects touched at the start.
    blockers : tuple of Blocker
        Objects that stop straight pulls, most pulls first.
    pulls, motions : int
        Straight pulls tried; motions that the planner asked about.
    poses : int
        Poses looked at.
    is_planned : bool
        Whether the planner was used.
    seconds : float
        Time of the search with its proofs.
    seed : int
    """

    parts: tuple[Object, ...]
    shell: PointShell
    way: WayOut | None
    touched: tuple[Object, ...]
    blockers: tuple[Blocker, ...]
    pulls: int
    motions: int
    poses: int
    is_planned: bool
    seconds: float
    seed: int

    @property
    def verdict(self) -> WayOutVerdict:
        """Proved result, or that no way was found: which is no proof that there is none."""
        return "no way found" if self.way is None else self.way.verdict
