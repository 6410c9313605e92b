"""Keys of results in JSON and columns of CSV, SI units; described in docs/results.md."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from operator import attrgetter
from typing import Any

FIELDS = {
    "Clash": "a a_name b b_name kind at_least at_most places=place status because rule volume",
    "CheckReport": (
        "is_sound url findings n_findings objects voxels rows surfaces wrong orphans lacks_pairs"
    ),
    "Difference": (
        "is_equal a b is_same_grid with_distances objects=compared voxels=n_voxels renumbered"
    ),
    "Disassembly": "verdict parts steps failed is_out_of_time elapsed=seconds seed",
    "Distance": "a=a.id a_name=a.name b=b.id b_name=b.name at_least at_most on_a on_b",
    "Extraction": (
        "verdict parts to path near blockers pulls motions queries=poses is_planned "
        "is_out_of_time elapsed=seconds seed"
    ),
    "FailedSearch": "parts after_steps=n_gone verdict reason blockers",
    "FileReport": (
        "file=link status present restored still_removed replaced dropped chord_error=chord "
        "is_unit_assumed defects notes error"
    ),
    "LoopFigures": "frames seconds missed lateness elapsed rate",
    "Object": "id name",
    "Parting": "frame time reason",
    "Removal": "excluded object=found",
    "Replayed": "is_equal frames=n_frames differing=n_differing revision parting",
    "Swept": (
        "verdict gap=gap.at_least gap_at_most=gap.at_most chord_error=gap.error nearest=gap.place "
        "comes_out hits touching enclosed undecided leaky contact overlap objects queries revision "
        "elapsed is_stopped length=path.length notes clouds cloud_radius"
    ),
    "TargetReach": "object verdict n_free n_angles free gap obstacles pose",
    "RemovalPath": "how poses length gap proof=swept",
}
"""Fields of a result in JSON, by its class, in the form of `record`; other classes give all."""
OBJECT = "id name link voxels bounds transform digest attributes revision"
"""Fields of an object in JSON, if it is a result itself."""
AXES = ("x", "y", "z")
_POSE = (*(f"{axis}_m" for axis in AXES), "qw", "qx", "qy", "qz")
_SPEED = (*(f"v{axis}_m_per_s" for axis in AXES), *(f"w{axis}_rad_per_s" for axis in AXES))
WRENCH = tuple(
    f"{of}_{axis}_{unit}" for of, unit in (("force", "N"), ("torque", "Nm")) for axis in AXES
)
COLUMNS = {
    **{key: (f"{key}_m",) for key in (
        "at_least", "at_most", "deepest", "depth", "gap", "reach", "start", "start_at_least",
    )},
    **{key: (f"{key}_s",) for key in ("time", "dt", "lateness", "elapsed")},
    **{key: tuple(f"{key}_{axis}_m" for axis in AXES) for key in ("on_tool", "on_object")},
    **{key: tuple(f"{key}_{name}" for name in _POSE) for key in ("hand", "tool")},
    "force": WRENCH[:3],
    "torque": WRENCH[3:],
    "place": _POSE[:3],
    **{key: (f"{key}_ids", f"{key}_names") for key in ("touched", "obstacles")},
    "places": tuple(f"{of}_{name}" for of in "ab" for name in _POSE[:3]),
    "volume": ("volume_m3",),
    "hand_velocity": tuple(f"hand_{name}" for name in _SPEED),
    "applied": tuple(f"applied_{name}" for name in WRENCH),
    "spring": (
        "spring_N_per_m", "turn_spring_Nm_per_rad", "cap_N", "turn_cap_Nm", "damping_Ns_per_m",
        "scale", "radius_m", "hold_s", "fade_s",
    ),
}  # fmt: skip
"""Columns of keys with a unit or several numbers; another key is its own column."""


def plain(value: Any) -> Any:  # noqa: ANN401 - a part of a result
    """Result, or a part of it, as values of JSON; infinity and NaN become None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if names := FIELDS.get(type(value).__name__):
        return record(value, names)
    if hasattr(value, "_fields"):
        return record(value, value._fields)
    if is_dataclass(value):
        return record(value, [one.name for one in fields(value)])
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, tuple | list):
        return [plain(one) for one in value]
    return str(value)


def record(value: object, names: str | Iterable[str]) -> dict[str, Any]:
    """Fields of a result, by name or ``name=path.of.attributes``; `object` adds its own fields."""
    values: dict[str, Any] = {}
    for text in names.split() if isinstance(names, str) else names:
        name, _, path = text.partition("=")
        one = plain(attrgetter(path or name)(value))
        values |= one if name == "object" else {name: one}
    return values
