"""Results of a search for a way out, in metres and displacements."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object
from hapticdb.sweeps.result import ContactDepth, Swept

Floats = NDArray[np.float64]

WayOutVerdict = Literal[
    "comes out", "slides out", "comes out of contact", "not decided", "no way found"
]


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
    depths : tuple of ContactDepth
        How deep the parts go into what they touch at their start, while they leave it.
    beside : Swept or None
        If they go no deeper than is allowed: the sweep of the whole path without these objects.
    """

    poses: Floats
    how: Literal["pull", "plan"]
    swept: Swept
    rest: Swept | None
    rest_from: float
    depths: tuple[ContactDepth, ...] = ()
    beside: Swept | None = None

    @property
    def cuts(self) -> tuple[ContactDepth, ...]:
        """Those of `depths` that are proved to grow by more than is allowed."""
        return tuple(one for one in self.depths if one.is_cut)

    @property
    def verdict(self) -> WayOutVerdict:
        """What is proved.

        "comes out": the parts meet nothing on the whole path. "slides out": at the start they touch
        objects, which they leave, and on the way never get deeper into them than there, by more
        than is allowed; they meet nothing else, and from `rest_from` on nothing at all. "comes out
        of contact": the same, but how deep they get is not proved. "not decided": neither.
        """
        if self.swept.comes_out:
            return "comes out"
        if self.cuts:
            return "not decided"
        if self.rest is not None and self.rest.comes_out and self._is_sliding:
            return "slides out"
        if self.rest is not None and self.rest.comes_out:
            return "comes out of contact"
        return "not decided"

    @property
    def _is_sliding(self) -> bool:
        """Whether all depths are bounded, and nothing else is met on the whole path."""
        is_bounded = bool(self.depths) and all(one.is_bounded for one in self.depths)
        return is_bounded and self.beside is not None and self.beside.comes_out

    @property
    def in_way(self) -> tuple[Object, ...]:
        """Objects that refute the path.

        It hits them, and not only by leaving them at its start, or it cuts into them.
        """
        if self.verdict != "not decided":
            return ()
        hit = tuple(one.object for one in self.swept.objects if not one.is_left_at_once)
        return hit + tuple(one.object for one in self.cuts)

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
