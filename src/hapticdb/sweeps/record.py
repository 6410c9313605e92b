"""A sweep's result for JSON: metres, fractions of the path, world frame."""

import math
from typing import Any

import numpy as np

from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object
from hapticdb.sweeps.result import Swept
from hapticdb.sweeps.verdict import verdict_line

FOUND = (
    "comes_out", "hits", "touching", "enclosed", "contact", "objects", "looks", "revision",
    "elapsed", "is_stopped",
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
        "gap": plain(found.gap.at_least),
        "gap_at_most": plain(found.gap.at_most),
        "nearest": plain(found.gap.place),
        "line": verdict_line(found, shell),
        **{name: plain(getattr(found, name)) for name in FOUND},
        "poses": len(found.path.poses),
        "profile": plain(found.profile),
        "tool": {"parts": parts, "excluded": excluded},
        "proportions": found.proportions.record(),
    }


def plain(value: Any) -> Any:  # noqa: ANN401 - a part of a result
    """Convert a part of a result; a number that is not known is None, since JSON has no infinity.

    An object is told by its id and name; the object of a part beside the part's own fields.
    """
    if isinstance(value, Object):
        return {"id": value.id, "name": value.name}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "_asdict"):
        told = value._asdict()
        about = plain(told.pop("object")) if "object" in told else {}
        return about | {name: plain(one) for name, one in told.items()}
    if isinstance(value, tuple | list):
        return [plain(one) for one in value]
    return value
