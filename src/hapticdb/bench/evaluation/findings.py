"""What cells say: CBGroup against the best MAXGAP, `auto` against the best strategy."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hapticdb.bench.cells import (
    ONE_STATEMENT,
    WHERE,
    Cell,
    Results,
    cells_of,
    distinct,
    form_of,
    frame_us,
    grouped,
    is_cut_short,
    least,
    number,
    ratio,
    with_strategy,
    word,
)

CLOSE = 1.05
"""CBGroup is as good as the best MAXGAP up to this ratio."""
AUTO_CLOSE = 1.10
"""`auto` is as good as the best strategy up to this ratio."""
CHOOSABLE = ("array", "cbgroup", "points", "statement")
"""What `auto` chooses among."""
OURS = "hapticdb"
"""How the names of its own cells begin among the peers'."""


@dataclass(frozen=True)
class Contest:
    """MaxGap and CBGroup side by side in one form, under the same conditions.

    where : conditions by name; form : of both; curve : MaxGap's cells by ascending MAXGAP; best :
    the fastest of them; cbgroup, array : the cells of these strategies, `array` if any.
    """

    where: Mapping[str, Any]
    form: str
    curve: Sequence[Cell]
    best: Cell
    cbgroup: Cell
    array: Cell | None

    @property
    def cbgroup_ratio(self) -> float:
        """CBGroup's time as a multiple of the best MAXGAP's."""
        return (frame_us(self.cbgroup) or 0.0) / (frame_us(self.best) or 1.0)

    @property
    def array_ratio(self) -> float | None:
        """Time of `array` as a multiple of CBGroup's."""
        return ratio(frame_us(self.array), frame_us(self.cbgroup)) if self.array else None

    @property
    def is_close(self) -> bool:
        """Whether CBGroup is within 5 % of the best MAXGAP, or better."""
        return self.cbgroup_ratio <= CLOSE

    @property
    def best_maxgap(self) -> int:
        """MAXGAP of the fastest cell."""
        return int(number(self.best, "maxgap") or 0)

    @property
    def plateau(self) -> tuple[int, int]:
        """Least and largest MAXGAP around the best one whose times are within 5 % of its."""
        limit = CLOSE * (frame_us(self.best) or 0.0)
        at = self.curve.index(self.best)
        first = last = at
        while first > 0 and (frame_us(self.curve[first - 1]) or 0.0) <= limit:
            first -= 1
        while last + 1 < len(self.curve) and (frame_us(self.curve[last + 1]) or 0.0) <= limit:
            last += 1
        gaps = [int(number(self.curve[n], "maxgap") or 0) for n in (first, last)]
        return gaps[0], gaps[1]

    def at(self, maxgap: int) -> Cell | None:
        """MaxGap's cell for one MAXGAP."""
        return next((cell for cell in self.curve if number(cell, "maxgap") == maxgap), None)


def contests(cells: Iterable[Cell]) -> list[Contest]:
    """Every set of conditions and form in which both MaxGap and CBGroup have a time."""
    found = []
    every = list(cells)
    for values, group in grouped(every, WHERE).items():
        where = dict(zip(WHERE, values, strict=True))
        for form in distinct([{"form": form_of(cell)} for cell in group], "form"):
            curve = [
                c for c in with_strategy(group, "maxgap", form) if number(c, "maxgap") is not None
            ]
            best = least(curve, frame_us)
            cbgroup = least(with_strategy(group, "cbgroup", form), frame_us)
            if best is None or cbgroup is None:
                continue
            curve.sort(key=lambda cell: number(cell, "maxgap") or 0.0)
            array = (
                least(with_strategy(group, "array"), frame_us) if form == ONE_STATEMENT else None
            )
            found.append(Contest(where, form, tuple(curve), best, cbgroup, array))
    return found


@dataclass(frozen=True)
class Choice:
    """`auto` beside every other strategy under the same conditions, in the same run.

    experiment : its name; where : conditions by name; auto, best : cells; best_choosable : the
    fastest of those that `auto` chooses among, if one was measured; own_us : times of the
    strategies by name.
    """

    experiment: str
    where: Mapping[str, Any]
    auto: Cell
    best: Cell
    best_choosable: Cell | None
    own_us: Mapping[str, float]

    @property
    def explained(self) -> float | None:
        """What its choices alone make of the ratio: the strategies' own times, by their shares."""
        shares = self._shares
        if not shares or not set(shares) <= set(self.own_us):
            return None
        mean = sum(share * self.own_us[name] for name, share in shares.items())
        return ratio(mean, frame_us(self.best))

    @property
    def ratio(self) -> float:
        """Time of `auto` as a multiple of the fastest strategy's."""
        return (frame_us(self.auto) or 0.0) / (frame_us(self.best) or 1.0)

    @property
    def choosable_ratio(self) -> float | None:
        """The same beside the fastest of those that it chooses among."""
        if self.best_choosable is None:
            return None
        return ratio(frame_us(self.auto), frame_us(self.best_choosable))

    @property
    def chosen(self) -> str:
        """What it chose, in per cent of the frames, most first."""
        most = sorted(self._shares.items(), key=lambda pair: -pair[1])
        return ", ".join(f"{name} {100 * share:.0f} %" for name, share in most)

    @property
    def _shares(self) -> dict[str, float]:
        """Share of the frames for which each strategy was chosen."""
        counts = self.auto.get("chosen") or {}
        known = {str(name): n for name in counts if (n := number(counts, name)) and n > 0}
        total = sum(known.values())
        return {name: n / total for name, n in known.items()}


def choices(results: Results) -> list[Choice]:
    """Every set of conditions in which `auto` and another strategy have a time.

    Cells that the time limit cut short are left out: they hold other poses than their neighbours.
    """
    found = []
    for experiment in results:
        if experiment in {"peers", "scale"}:
            keys: tuple[str, ...] = (*WHERE, "object_voxels")
        else:
            keys = WHERE
        cells = [
            cell
            for cell in cells_of(results, experiment)
            if word(cell, "strategy") and form_of(cell) == ONE_STATEMENT and not is_cut_short(cell)
        ]
        for values, group in grouped(cells, keys).items():
            auto = least(with_strategy(group, "auto"), frame_us)
            others = [cell for cell in group if cell.get("strategy") != "auto"]
            best = least(others, frame_us)
            if auto is None or best is None:
                continue
            choosable = least([c for c in others if c.get("strategy") in CHOOSABLE], frame_us)
            where = dict(zip(keys, values, strict=True))
            own_us = {
                word(c, "strategy"): us
                for c in others
                if number(c, "maxgap") is None and (us := frame_us(c)) is not None
            }
            found.append(Choice(experiment, where, auto, best, choosable, own_us))
    return found


def repeats(results: Results) -> list[float]:
    """Longest over shortest typical time of what several experiments of the run measured alike."""
    times: dict[tuple[Any, ...], list[float]] = {}
    keys = (*WHERE, "strategy", "form", "maxgap", "resolution")
    for experiment in results:
        if experiment in {"peers", "scale"}:
            continue
        for values, group in grouped(cells_of(results, experiment), keys).items():
            cell = least(group, frame_us)
            if cell is not None and word(cell, "strategy") and len(group) == 1:
                times.setdefault(values, []).append(frame_us(cell) or 0.0)
    return sorted(max(own) / min(own) for own in times.values() if len(own) > 1 and min(own) > 0)


def is_ours(cell: Cell) -> bool:
    """Whether a cell of the peers is hapticdb's own."""
    return word(cell, "peer").startswith(OURS)


def asks_the_same(cell: Cell) -> bool:
    """Whether a peer finds the same hits."""
    return is_ours(cell) or word(cell, "question").startswith("the same")
