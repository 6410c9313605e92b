"""CBGroup against the best MAXGAP, wherever both were measured."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hapticdb.bench.cells import (
    ONE_STATEMENT,
    WHERE,
    Cell,
    distinct,
    form_of,
    frame_us,
    grouped,
    least,
    number,
    ratio,
    with_strategy,
)

CLOSE = 1.05
"""CBGroup counts as good as the best MAXGAP up to this ratio of their times. A larger value counts
more contests as close, and widens the plateaus."""


@dataclass(frozen=True)
class Contest:
    """MaxGap and CBGroup under the same conditions and in the same form.

    where : conditions by name; form : one statement, or a loop in the server; curve : MaxGap's
    cells by ascending MAXGAP; best : the fastest of them; cbgroup, array : cells of these
    strategies, `array` None where it was not measured.
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
