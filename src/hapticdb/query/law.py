"""Force laws of the API (the paper, section 3); their arithmetic is in `kernels.force_law`."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Protocol

from hapticdb.errors import UsageError
from hapticdb.kernels import force_law as kernels
from hapticdb.kernels.field import distance_law as field

LawName = Literal["plane", "distance"]
MOST_STIFFNESS = 1e9
"""Largest stiffness of a law, N/m: stiffer than any hand, device or part."""


def inset_of(voxel_size: float, law: "ForceLaw | LawName") -> float:
    """Inward offset of a tool's points, metres, for contact to begin at its surface."""
    return float(field.ONSET * voxel_size) if reads_distances(law) else 0.0


class ForceLaw(Protocol):
    """A force law: its stiffness, and its parameters for kernels."""

    @property
    def stiffness(self) -> float:
        """K, N/m."""

    @property
    def for_kernels(self) -> Any:  # noqa: ANN401 - a NamedTuple of a type of its own
        """NamedTuple with functions in `hapticdb.kernels.force_law`; made once, read by frames."""


@dataclass(frozen=True)
class _Stiff:
    stiffness: float = 1000.0
    """K, N/m, `MOST_STIFFNESS` at most."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.stiffness <= MOST_STIFFNESS:
            raise UsageError(
                f"stiffness {self.stiffness} N/m: give a number from 0 to {MOST_STIFFNESS:g}"
            )
        object.__setattr__(self, "stiffness", float(self.stiffness))


@dataclass(frozen=True)
class TangentPlane(_Stiff):
    """Tangent-plane law of VPS (McNeely, Puterbaugh and Troy, SIGGRAPH 1999).

    The plane of a shell point p goes through the centre c of its voxel, with the point's inward
    normal n: d = max(0, (c - p) . n), F = K d n, tau = (p - x_cm) x F. With N >= 10 hits force and
    torque are divided by N / 10. The force jumps as a point crosses a voxel's border: a property of
    the law.
    """

    name: ClassVar[LawName] = "plane"

    @cached_property
    def for_kernels(self) -> Any:  # noqa: ANN401 - kernels are loaded when they are first used
        """The law's NamedTuple for kernels."""
        return kernels.TangentPlaneLaw(self.stiffness)


@dataclass(frozen=True)
class DistanceField(_Stiff):
    """Penalty on the distance field: the force of a point depends on its distance u to a surface.

    After Barbic and James 2008.

    u is in voxels, interpolated between the stored distances at the 8 voxel centres around the
    point; at each centre the least distance of all objects counts. With the voxel size s and the
    point's inward normal n: d = g s max(0, 1.5 - u), F = K sum d n / max(1, W / 10), torque alike.
    W is the sum of the points' weights g clamp(2.5 - u, 0, 1). So contact begins 1.5 voxels before
    the surface, and the force is continuous in the pose.

    The share g = clamp((u(p + 0.4 n) - u(p)) / 0.1, 0, 1) lets a point push only as far as u grows
    into the tool. Without it the two sides of a thin wall would cancel: their normals are opposite
    and their distances almost equal.

    The law needs distances of every object in the environment.
    """

    name: ClassVar[LawName] = "distance"

    @cached_property
    def for_kernels(self) -> Any:  # noqa: ANN401 - likewise
        """The law's NamedTuple for kernels."""
        return field.DistanceFieldLaw(self.stiffness)


PLANE, DISTANCE = TangentPlane(), DistanceField()
"""The laws with their default stiffness."""
LAWS: dict[str, TangentPlane | DistanceField] = {law.name: law for law in (PLANE, DISTANCE)}
"""Laws chosen by a name, on the command line and in recordings."""


def as_law(law: "ForceLaw | LawName | None") -> ForceLaw | None:
    """A law, or the one of that name; None stays None."""
    return law_named(law) if isinstance(law, str) else law


def law_named(name: str, stiffness: float | None = None) -> TangentPlane | DistanceField:
    """Law of that name, with the stiffness, N/m, if given; UsageError for other names."""
    if name not in LAWS:
        raise UsageError(f"law {name!r}: choose one of {', '.join(LAWS)}")
    return LAWS[name] if stiffness is None else replace(LAWS[name], stiffness=stiffness)


def reads_distances(law: ForceLaw | LawName) -> bool:
    """Whether a law, or the law of that name, reads distances to surfaces."""
    chosen = as_law(law)
    return chosen is not None and kernels.reads_distances(chosen.for_kernels)
