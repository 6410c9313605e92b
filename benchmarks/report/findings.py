"""`auto` against the best strategy, conditions that were measured twice, and peers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hapticdb.bench.cells import (
    ONE_STATEMENT,
    WHERE,
    Cell,
    Results,
    cells_of,
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

AUTO_CLOSE = 1.10
"""`auto` counts as good as the best strategy up to this ratio of their times."""
CHOOSABLE = ("array", "cbgroup", "points", "statement")
"""What `auto` chooses among."""
OURS = "hapticdb"
"""How the names of hapticdb's own cells begin among the peers'."""


@dataclass(frozen=True)
class AutoChoice:
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
        """Ratio that its choices alone would give: the strategies' own times by their shares."""
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
        """Time of `auto` as a multiple of the fastest strategy that it can choose."""
        if self.best_choosable is None:
            return None
        return ratio(frame_us(self.auto), frame_us(self.best_choosable))

    @property
    def chosen(self) -> str:
        """Strategies that it chose, in per cent of the frames, the most frequent first."""
        most = sorted(self._shares.items(), key=lambda pair: -pair[1])
        return ", ".join(f"{name} {100 * share:.0f} %" for name, share in most)

    @property
    def _shares(self) -> dict[str, float]:
        """Share of the frames for which each strategy was chosen."""
        counts = self.auto.get("chosen") or {}
        known = {str(name): n for name in counts if (n := number(counts, name)) and n > 0}
        total = sum(known.values())
        return {name: n / total for name, n in known.items()}


def choices(results: Results) -> list[AutoChoice]:
    """Every set of conditions in which `auto` and another strategy have a time.

    Cells that the time limit cut short are left out: they have fewer poses than the others.
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
            found.append(AutoChoice(experiment, where, auto, best, choosable, own_us))
    return found


def repeats(results: Results) -> list[float]:
    """Longest over shortest typical time of each cell that several experiments measured."""
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
