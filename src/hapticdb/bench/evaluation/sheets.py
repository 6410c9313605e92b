"""Which pictures there are: one for each set of conditions that a plot does not show itself."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from hapticdb.bench.cells import (
    PAPER_POINT,
    Cell,
    Results,
    cells_of,
    distinct,
    frame_us,
    named,
    number,
    word,
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
class Kind:
    """A way to draw an experiment.

    name : of the pictures' files, and of what draws it; experiment : whose cells; title : headline;
    shown : conditions that the plot itself shows, the others stand on a sheet each; can_show :
    whether a cell has what is drawn.
    """

    name: str
    experiment: str
    title: str
    shown: Sequence[str]
    can_show: Callable[[Cell], bool]

    @property
    def parted(self) -> list[str]:
        """Conditions that stand on a sheet each."""
        return [key for key in CONDITIONS if key not in self.shown]


@dataclass(frozen=True)
class Sheet:
    """One picture: its file's name without the ending, how it is drawn, and of which cells."""

    name: str
    kind: Kind
    cells: Sequence[Cell]

    @property
    def conditions(self) -> str:
        """What all its cells share, in words."""
        return "; ".join(conditions(self.cells, self.kind.shown))


def _has_time(cell: Cell) -> bool:
    return frame_us(cell) is not None


def _has_median(cell: Cell) -> bool:
    return frame_us(cell, "p50") is not None


def _has_gap(cell: Cell) -> bool:
    strategy = cell.get("strategy")
    known = strategy in {"cbgroup", "array"} or number(cell, "maxgap") is not None
    return known and _has_time(cell)


def _has_rows(cell: Cell) -> bool:
    return _has_gap(cell) and number(cell, "rows") is not None and cell.get("strategy") != "array"


def _has_key(key: str) -> Callable[[Cell], bool]:
    return lambda cell: _has_time(cell) and number(cell, key) is not None


def _is_speed(cell: Cell) -> bool:
    return (number(cell, "voxels_per_second") or 0) > 0


KINDS = (
    Kind(
        "figure8",
        "figure8",
        "Figure 8: resolution of the quantile vector",
        ("resolution",),
        _has_key("resolution"),
    ),
    Kind("figure9", "figure9", "Figure 9: MaxGap against CBGroup, time a frame", (), _has_gap),
    Kind(
        "figure9-rows",
        "figure9",
        "Figure 9: MaxGap against CBGroup, ranges and rows",
        ("cache", "file"),
        _has_rows,
    ),
    Kind(
        "figure10",
        "figure10",
        "Figure 10: MaxGap against CBGroup by voxel density",
        (),
        lambda cell: _has_gap(cell) and bool(word(cell, "region")),
    ),
    Kind(
        "conditions",
        "conditions",
        "Database's cache and operating system's cache",
        ("cache", "file"),
        _has_time,
    ),
    Kind(
        "strategies",
        "strategies",
        "Strategies: half of the frames, and 99 in 100",
        (),
        _has_median,
    ),
    Kind("layouts", "layouts", "Curves and layouts", ("curve",), _has_time),
    Kind(
        "points",
        "points",
        "Time a frame against the shell's points",
        ("points",),
        _has_key("points"),
    ),
    Kind("tail", "tail", "The slowest frames", (), _has_median),
    Kind(
        "peers",
        "peers",
        "hapticdb beside its peers",
        ("cache", "file", "curve"),
        lambda cell: _has_median(cell) and bool(word(cell, "peer")),
    ),
    Kind("voxelizing", "voxelizing", "Voxelizing CAD parts", (), _is_speed),
    Kind(
        "scale",
        "scale",
        "Time a frame and storage against the environment's size",
        ("environment", "poses"),
        lambda cell: (number(cell, "object_voxels") or 0) > 0,
    ),
)


def sheets(results: Results) -> list[Sheet]:
    """Pictures that can be drawn of some results, the paper's conditions first."""
    return [
        sheet
        for kind in KINDS
        for sheet in _parted(
            kind, [c for c in cells_of(results, kind.experiment) if kind.can_show(c)]
        )
    ]


def sheets_of(results: Results, experiment: str) -> list[Sheet]:
    """Pictures of one experiment."""
    return [sheet for sheet in sheets(results) if sheet.kind.experiment == experiment]


def _parted(kind: Kind, cells: Sequence[Cell]) -> Iterable[Sheet]:
    """A sheet for each combination of conditions; its name tells what differs from the first."""
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
        yield Sheet(name, kind, tuple(parts[own]))


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
