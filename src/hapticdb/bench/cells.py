"""Reading measured cells: any number may be missing, and values have one fixed order."""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

Cell = Mapping[str, Any]
"""One measured combination: conditions, counts, percentiles."""
Result = Mapping[str, Any]
"""One experiment as its JSON holds it: machine, versions, inputs, notes, cells."""
Results = Mapping[str, Result]
"""Experiments by name."""

FRAME_US = 1000.0
"""Microseconds that a frame may take at 1000 frames a second; tables and plots mark it."""
ONE_STATEMENT = "one statement"
IN_THE_SERVER = "loop in the server"
PAPER_POINT: Mapping[str, Any] = {
    "layout": "brick",
    "curve": "z-order",
    "cache": "4 MB",
    "file": "cached",
    "poses": "slide",
    "shell": "sphere",
    "points": 300,
}
"""Conditions of the paper's experiments. An experiment varies one of them and keeps the others."""
ORDERS: Mapping[str, Sequence[str]] = {
    "engine": ("SQLite", "PostgreSQL"),
    "layout": ("brick", "voxel"),
    "curve": ("z-order", "hilbert", "lexicographic"),
    "cache": ("4 MB", "all cached"),
    "file": ("cached", "cold"),
    "poses": ("slide", "random", "recorded"),
    "region": ("low", "middle", "high"),
    "strategy": ("points", "statement", "array", "maxgap", "cbgroup", "auto"),
    "form": (ONE_STATEMENT, IN_THE_SERVER),
}
NAMES: Mapping[str, str] = {
    "brick": "bricks",
    "voxel": "voxels",
    "z-order": "Z-order",
    "hilbert": "Hilbert",
    "maxgap": "MaxGap",
    "cbgroup": "CBGroup",
}
"""Names in text and plots. A value that is not listed is shown as it is."""
WHERE = (
    "environment",
    "engine",
    "layout",
    "curve",
    "cache",
    "file",
    "poses",
    "shell",
    "points",
    "region",
)
"""Conditions of a cell. Times are compared only where all of these are equal."""


def cells_of(results: Results, name: str) -> list[Cell]:
    """Cells of an experiment, without their empty values; no cells when it was not run."""
    cells = results.get(name, {}).get("cells") or ()
    return [{key: value for key, value in cell.items() if _is_said(value)} for cell in cells]


def _is_said(value: object) -> bool:
    return (
        value is not None and value != "" and not (isinstance(value, float) and math.isnan(value))
    )


def number(cell: Cell, key: str) -> float | None:
    """Value of a cell; None when it is missing or no finite number."""
    value = cell.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def frame_us(cell: Cell, measure: str = "typical") -> float | None:
    """Microseconds a frame; None when it was not measured.

    Parameters
    ----------
    cell : Cell
        One measured combination.
    measure : str
        Of its frames: ``typical``, ``mean``, ``p50``, ``p99``, ``p99.9``, ``max``, ...
    """
    value = number(cell.get("us") or {}, measure)
    return value if value is not None and value > 0 else None


def word(cell: Cell, key: str) -> str:
    """Text of a cell; empty when it is missing."""
    value = cell.get(key)
    return "" if value is None else str(value)


def form_of(cell: Cell) -> str:
    """How the ranges were sent: in one statement, unless the cell says otherwise."""
    return word(cell, "form") or ONE_STATEMENT


def named(value: object) -> str:
    """Name of a layout, curve or strategy in text and plots."""
    return NAMES.get(str(value), str(value))


def is_cut_short(cell: Cell) -> bool:
    """Whether the time limit ended it before all poses were measured."""
    return bool(cell.get("cut_short"))


def with_strategy(cells: Iterable[Cell], strategy: str, form: str = ONE_STATEMENT) -> list[Cell]:
    """Cells of one strategy in one form that have a time."""
    return [
        cell
        for cell in cells
        if cell.get("strategy") == strategy and form_of(cell) == form and frame_us(cell) is not None
    ]


def distinct(cells: Iterable[Cell], key: str) -> list[Any]:
    """Values that cells have, each once: in the order of `ORDERS`, else by name and number."""
    found = {cell[key]: None for cell in cells if cell.get(key) is not None}
    known = list(ORDERS.get(key, ()))

    def place(value: object) -> tuple[int, list[tuple[int, float, str]]]:
        name = re.sub(r" [\d.]+$", "", str(value))  # an engine without its version
        return known.index(name) if name in known else len(known), _pieces(value)

    return sorted(found, key=place)


def _pieces(value: object) -> list[tuple[int, float, str]]:
    """Numbers in a name as numbers, so that 15 stands before 18 and 300 before 1000."""
    if isinstance(value, int | float):
        return [(0, float(value), "")]
    parts = re.split(r"(\d+)", str(value))
    return [(0, float(p), "") if p.isdigit() else (1, 0.0, p.lower()) for p in parts if p]


def grouped(cells: Iterable[Cell], keys: Sequence[str]) -> dict[tuple[Any, ...], list[Cell]]:
    """Cells by the values of some keys, in the order of `distinct`; None is a missing value.

    Parameters
    ----------
    cells : iterable of Cell
        The cells to group.
    keys : sequence of str
        Keys of a group; the first varies slowest.
    """
    every = list(cells)
    orders = [[*distinct(every, key), None] for key in keys]
    groups: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in every:
        groups.setdefault(tuple(cell.get(key) for key in keys), []).append(cell)

    def place(values: tuple[Any, ...]) -> list[int]:
        return [order.index(value) for order, value in zip(orders, values, strict=True)]

    return dict(sorted(groups.items(), key=lambda item: place(item[0])))


def least(cells: Iterable[Cell], measure: Callable[[Cell], float | None]) -> Cell | None:
    """Cell with the smallest measure; None where no cell has one."""
    known = [(value, cell) for cell in cells if (value := measure(cell)) is not None]
    return min(known, key=lambda pair: pair[0])[1] if known else None


def ratio(one: float | None, other: float | None) -> float | None:
    """One as a multiple of the other; None when either is missing, or the other 0."""
    return one / other if one is not None and other else None
