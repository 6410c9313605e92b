"""The force law as users name it (the paper, section 3); its arithmetic is `hapticdb.kernels.law`.

A law of this module is checked and immutable, and gives kernels the NamedTuple that they take.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

from hapticdb.errors import UsageError
from hapticdb.kernels import law as kernels

MOST_STIFFNESS = 1e9
"""N/m: stiffer than any hand, device or part."""


class ForceLaw(Protocol):
    """A force law: how stiff it is, and what kernels take of it."""

    @property
    def stiffness(self) -> float:
        """K, N/m."""

    @property
    def for_kernels(self) -> Any:  # noqa: ANN401 - a NamedTuple of a type of its own
        """NamedTuple that `hapticdb.kernels.law` has functions for; made once, a frame reads it."""


@dataclass(frozen=True)
class TangentPlane:
    """Tangent-plane law of VPS (McNeely, Puterbaugh and Troy, SIGGRAPH 1999).

    Through the centre c of the voxel that holds the shell point p goes a plane with the point's
    inward normal n: d = max(0, (c - p) . n), F = K d n, tau = (p - x_cm) x F. With N >= 10 hits
    force and torque are divided by N / 10. The force jumps where a point crosses a voxel's border:
    a property of the law.

    Attributes
    ----------
    stiffness : float
        K, N/m, `MOST_STIFFNESS` at most.
    """

    stiffness: float = 1000.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.stiffness <= MOST_STIFFNESS:
            raise UsageError(
                f"stiffness {self.stiffness} N/m: give a number from 0 to {MOST_STIFFNESS:g}"
            )
        object.__setattr__(self, "stiffness", float(self.stiffness))

    @cached_property
    def for_kernels(self) -> Any:  # noqa: ANN401 - kernels are loaded when they are first used
        """Law as kernels take it."""
        return kernels.TangentPlaneLaw(self.stiffness)
