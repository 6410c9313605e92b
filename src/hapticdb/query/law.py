"""Hits -> wrench: the force law (the paper, section 3).

The arithmetic runs in `hapticdb.kernels.query.contact`, fused with the refinement of a frame's
rows, and once more inside the engine for the strategy `statement`; both share the same leaves.
"""

from dataclasses import dataclass

from hapticdb.errors import UsageError

MOST_STIFFNESS = 1e9
"""N/m: stiffer than any hand, device or part."""


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
