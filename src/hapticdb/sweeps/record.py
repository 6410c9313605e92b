"""A sweep's result for JSON: metres, fractions of the path, world frame."""

import math
from typing import Any

import numpy as np

from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object
from hapticdb.sweeps.result import ContactDepth, Decision, MetObject, Proof, Swept
from hapticdb.sweeps.verdict import verdict_line

MORE: dict[type, tuple[str, ...]] = {
    Proof: ("is_clear", "cover_needed"),
    Decision: ("is_near",),
    ContactDepth: ("is_bounded", "is_cut"),
    MetObject: ("first", "last"),
}
"""What is told of a part of a result beside its fields."""
FOUND = (
    "samples", "hits", "contacts", "first_hit", "first_contact", "deepest", "enclosed",
    "hit_intervals", "contact_intervals", "clearance", "revision", "elapsed", "cells", "at_least",
    "looked", "left_at_start", "decision", "depths",
)  # fmt: skip
"""What is told of a `Swept` as it is."""


def sweep_record(
    found: Swept, shell: PointShell, parts: list[int], excluded: list[int]
) -> dict[str, Any]:
    """Convert a sweep's result to numbers and strings, as `hapticdb sweep --json` prints it.

    shell : the tool; parts : ids of the objects that it was made of, empty for a tool from a file;
    excluded : ids of the objects that the sweep left out.
    """
    return {
        "verdict": found.verdict,
        "comes_out": found.comes_out,
        "line": verdict_line(found, shell),
        "proof": plain(found.proof),
        "poses": len(found.path.poses),
        **{name: plain(getattr(found, name)) for name in FOUND},
        "objects": [
            plain(one) | {"first_contact": one.first_contact and one.first_contact.fraction}
            for one in found.objects
        ],
        "tool": {
            "points": len(shell),
            "spacing": median_spacing(shell),
            "parts": parts,
            "excluded": excluded,
        },
        "proportions": found.proportions.record(),
    }


def plain(value: Any) -> Any:  # noqa: ANN401 - a part of a result
    """Convert a part of a result; a number that is not known is None, since JSON has no infinity.

    An object is told by its id and name; the object of a part beside the part's own fields.
    """
    if isinstance(value, Object):
        return {"id": value.id, "name": value.name}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "_asdict"):
        told = value._asdict() | {name: getattr(value, name) for name in MORE.get(type(value), ())}
        about = plain(told.pop("object")) if "object" in told else {}
        return about | {name: plain(one) for name, one in told.items()}
    if isinstance(value, tuple | list):
        return [plain(one) for one in value]
    return value


def median_spacing(shell: PointShell) -> float:
    """Median distance from a point to its nearest neighbour, metres; 0 for a single point.

    Computed from about a thousand of the shell's points, spread evenly by index.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second

    if len(shell) < 2:
        return 0.0
    some = shell.points[:: max(1, len(shell) // 1000)]
    distances, _ = cKDTree(shell.points).query(some, k=2)
    return float(np.median(np.asarray(distances)[:, 1]))
