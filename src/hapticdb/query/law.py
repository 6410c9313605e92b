"""The force law for users (the paper, section 3); its arithmetic is in `hapticdb.kernels.law`.

A law of this module is checked and immutable, and makes the NamedTuple that kernels take.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

from hapticdb.errors import UsageError
from hapticdb.kernels import law as kernels

MOST_STIFFNESS = 1e9
"""Largest stiffness of a law, N/m: stiffer than any hand, device or part."""


class ForceLaw(Protocol):
    """A force law: its stiffness, and its numbers for kernels."""

    @property
    def stiffness(self) -> float:
        """K, N/m."""

    @property
    def for_kernels(self) -> Any:  # noqa: ANN401 - a NamedTuple of a type of its own
        """NamedTuple for which `hapticdb.kernels.law` has functions; made once, read by frames."""


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
        """The law's NamedTuple for kernels."""
        return kernels.TangentPlaneLaw(self.stiffness)
