"""Which force law a name means, and whether it reads distances."""

from hapticdb.errors import UsageError
from hapticdb.query.law import (
    LAW_NAMES,
    PLANE,
    SMOOTH,
    DistanceField,
    ForceLaw,
    LawName,
    TangentPlane,
)


def law_named(name: str, stiffness: float) -> TangentPlane | DistanceField:
    """Law of that name and stiffness, N/m.

    Raises
    ------
    UsageError
        If there is no such law, or the stiffness is out of its range.
    """
    if name not in LAW_NAMES:
        raise UsageError(f"law {name!r}: this hapticdb has {', '.join(LAW_NAMES)}")
    return TangentPlane(stiffness) if name == PLANE.name else DistanceField(stiffness)


def is_smooth(law: ForceLaw | LawName) -> bool:
    """Whether a law, or the law of that name, reads distances to surfaces."""
    return law == SMOOTH.name or isinstance(law, DistanceField)
