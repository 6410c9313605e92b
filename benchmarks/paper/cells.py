"""Reading measured cells: their names in text, their order, groups that differ in one thing."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Cell = Mapping[str, Any]
"""One measured combination: conditions, counts, percentiles."""
Results = Mapping[str, Mapping[str, Any]]
"""Experiments by name, as their JSON holds them: machine, versions, inputs, notes, cells."""

FRAME_US = 1000.0
"""Microseconds that a frame may take at 1000 frames a second."""
WHERE = ("engine", "layout", "law", "file", "poses", "points", "region")
"""Conditions of a cell. Times are compared only where all of these are equal."""
ORDERS: Mapping[str, Sequence[object]] = {
    "layout": ("brick", "voxel"),
    "poses": ("slide", "random"),
    "law": ("plane", "distance"),
    "file": ("cached", "cold"),
    "region": ("low", "middle", "high"),
    "strategy": ("points", "statement", "array", "maxgap", "cbgroup"),
}
NAMES: Mapping[object, str] = {
    "brick": "bricks",
    "voxel": "voxels",
    "maxgap": "MaxGap",
    "cbgroup": "CBGroup",
}
"""Names in text and plots. A value that is not listed is shown as it is."""


def named(value: object) -> str:
    """Name of a layout, curve or strategy in text and plots."""
    return NAMES.get(value, str(value))


def typical(cell: Cell) -> float:
    """Microseconds a frame: the mean of the frames between the 5th and the 95th percentile."""
    return float(cell["us"]["typical"])


def _rank(key: str, value: object) -> tuple[int, float, str]:
    """Place of a value among those of a key: SQLite first, then versions of PostgreSQL."""
    if key in ORDERS:
        known = ORDERS[key]
        return known.index(value) if value in known else len(known), 0.0, str(value)
    if key == "engine":
        version = re.search(r"[\d.]+$", str(value))
        return "PostgreSQL" in str(value), float(version[0].split(".")[0]) if version else 0.0, ""
    return 0, float(value) if isinstance(value, int | float) else 0.0, str(value)


def distinct(cells: Iterable[Cell], key: str) -> list[Any]:
    """Values that cells have, each once, in order."""
    return sorted({cell.get(key) for cell in cells}, key=lambda value: _rank(key, value))


def grouped(
    cells: Iterable[Cell], keys: Sequence[str] = WHERE
) -> dict[tuple[Any, ...], list[Cell]]:
    """Cells by the values of some keys, in order; the first key varies slowest."""
    groups: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in cells:
        groups.setdefault(tuple(cell.get(key) for key in keys), []).append(cell)

    def place(values: tuple[Any, ...]) -> list[tuple[int, float, str]]:
        return [_rank(key, value) for key, value in zip(keys, values, strict=True)]

    return dict(sorted(groups.items(), key=lambda item: place(item[0])))


def by_strategy(cells: Iterable[Cell]) -> dict[str, Cell]:
    """The fastest cell of each strategy."""
    found: dict[str, Cell] = {}
    for cell in sorted(cells, key=typical):
        found.setdefault(cell["strategy"], cell)
    return found
