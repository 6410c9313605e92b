"""Which plots there are: one for each set of conditions that a plot does not show itself."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from hapticdb.bench.cells import (
    PAPER_POINT,
    Cell,
    Results,
    cells_of,
    distinct,
    frame_us,
    named,
    number,
)

CONDITIONS = ("environment", "curve", "cache", "file", "poses", "shell", "points")
POSES = {
    "slide": "poses that slide over surfaces",
    "random": "random poses near surfaces",
    "recorded": "the recorded path",
}
FILES = {
    "cached": "file in the operating system's cache",
    "cold": "file not in the operating system's cache",
}


@dataclass(frozen=True)
class PlotKind:
    """One way to draw an experiment.

    name : how the names of its files begin; experiment : whose cells it draws; title : headline;
    shown : conditions that the plot itself shows (each combination of the others gets a plot of its
    own); can_show : whether a cell has the values that are drawn; paint : draws one plot.
    """

    name: str
    experiment: str
    title: str
    shown: Sequence[str]
    can_show: Callable[[Cell], bool]
    paint: "Callable[[Plot], Figure]"

    @property
    def parted(self) -> list[str]:
        """Conditions of which each combination gets a plot of its own."""
        return [key for key in CONDITIONS if key not in self.shown]


@dataclass(frozen=True)
class Plot:
    """One plot: its file's name without the ending, how it is drawn, and of which cells."""

    name: str
    kind: PlotKind
    cells: Sequence[Cell]

    @property
    def conditions(self) -> str:
        """What all its cells share, in words."""
        return "; ".join(conditions(self.cells, self.kind.shown))

    @property
    def caption(self) -> str:
        """Title and conditions, for a reader who does not see the plot."""
        return ": ".join(filter(None, [self.kind.title, self.conditions]))


def has_time(cell: Cell) -> bool:
    """Whether a cell has a typical time of a frame."""
    return frame_us(cell) is not None


def has_median(cell: Cell) -> bool:
    """Whether a cell has a median time of a frame."""
    return frame_us(cell, "p50") is not None


def has_gap(cell: Cell) -> bool:
    """Whether a cell is MaxGap's with a known MAXGAP, or one that MaxGap is compared with."""
    strategy = cell.get("strategy")
    known = strategy in {"cbgroup", "array"} or number(cell, "maxgap") is not None
    return known and has_time(cell)


def has_rows(cell: Cell) -> bool:
    """Whether a cell counts the ranges and rows of a grouping."""
    return has_gap(cell) and number(cell, "rows") is not None and cell.get("strategy") != "array"


def has_number(key: str) -> Callable[[Cell], bool]:
    """Whether a cell has a typical time, and a number under that key."""
    return lambda cell: has_time(cell) and number(cell, key) is not None


def plots_among(results: Results, kinds: Iterable[PlotKind]) -> list[Plot]:
    """Plots of some kinds that the results have cells for, the paper's conditions first."""
    return [
        plot
        for kind in kinds
        for plot in _parted(
            kind, [c for c in cells_of(results, kind.experiment) if kind.can_show(c)]
        )
    ]


def _parted(kind: PlotKind, cells: Sequence[Cell]) -> Iterable[Plot]:
    """A plot for each combination of conditions; its name tells what differs from the first."""
    base = {key: _base(cells, key) for key in kind.parted}
    parts: dict[tuple[object, ...], list[Cell]] = {}
    for cell in cells:
        # what does not apply to a cell does not part it from those it is compared with
        own = tuple(base[key] if cell.get(key) is None else cell[key] for key in kind.parted)
        parts.setdefault(own, []).append(cell)

    def differing(own: tuple[object, ...]) -> list[object]:
        return [value for key, value in zip(kind.parted, own, strict=True) if value != base[key]]

    order = sorted(parts, key=lambda own: (len(differing(own)), list(parts).index(own)))
    taken: set[str] = set()
    for own in order:
        name = "-".join([kind.name, *(_slug(value) for value in differing(own))])
        while name in taken:
            name += "-x"
        taken.add(name)
        yield Plot(name, kind, tuple(parts[own]))


def _base(cells: Sequence[Cell], key: str) -> object:
    values = distinct(cells, key)
    if not values or PAPER_POINT.get(key) in values:
        return PAPER_POINT.get(key)
    return values[0]


def _slug(value: object) -> str:
    return re.sub(r"[^a-z0-9]+", "-", str(value).lower()).strip("-") or "other"


def conditions(cells: Sequence[Cell], shown: Sequence[str] = ()) -> list[str]:
    """What holds for some cells, a few words each; what a plot shows itself is left out."""
    said = []
    for key, in_words in _WORDS.items():
        values = [] if key in shown else distinct(cells, key)
        if values:
            said.append(in_words([str(value) for value in values]))
    frames = sorted({int(n) for cell in cells if (n := number(cell, "frames")) is not None})
    if frames:
        least, most = f"{frames[0]:,}", f"{frames[-1]:,}"
        said.append(f"{least if least == most else f'{least} to {most}'} frames a cell")
        said.append("one session")
    return said


def _points(values: Sequence[str]) -> str:
    return " / ".join(f"{int(float(value)):,}" for value in values) + " points"


def _quantiles(values: Sequence[str]) -> str:
    return " / ".join(f"{int(float(value)):,}" for value in values) + " quantiles"


_WORDS: dict[str, Callable[[Sequence[str]], str]] = {
    "environment": lambda values: "environment " + ", ".join(values),
    "points": _points,
    "shell": lambda values: "shell of a " + " / ".join(values),
    "poses": lambda values: " / ".join(POSES.get(value, value) for value in values),
    "curve": lambda values: " / ".join(named(value) for value in values),
    "resolution": _quantiles,
    "cache": lambda values: "database cache " + " / ".join(values),
    "file": lambda values: " / ".join(FILES.get(value, value) for value in values),
}
