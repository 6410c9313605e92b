"""Pairs of objects as the table `pair` keeps them, and what a store does with them."""

import os
from collections.abc import Callable, Container, Iterator, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from hapticdb.verdicts import Kind

Status = Literal["new", "gone", "changed", "same"]
Says = Literal["meant", "apart", "ignore"]
STATUSES: tuple[Status, ...] = get_args(Status)
SAYS: tuple[Says, ...] = get_args(Says)

COLUMNS = "a, b, kind, at_least, at_most, a_x, a_y, a_z, b_x, b_y, b_z, status, revision, setting"
"""Columns of the table `pair` that a measurement writes."""
ALL = f"SELECT {COLUMNS}, because, shapes FROM pair ORDER BY a, b"
A, B, KIND, SETTING, BECAUSE = map(
    [*COLUMNS.split(", "), "because"].index, ("a", "b", "kind", "setting", "because")
)
"""Places of columns in a row of `ALL` as the engine gives it."""
PUT = f"""
INSERT INTO pair ({COLUMNS}) {{values}}
    ON CONFLICT (a, b) DO UPDATE
   SET kind = excluded.kind, at_least = excluded.at_least, at_most = excluded.at_most,
       a_x = excluded.a_x, a_y = excluded.a_y, a_z = excluded.a_z, b_x = excluded.b_x,
       b_y = excluded.b_y, b_z = excluded.b_z, status = excluded.status,
       revision = excluded.revision, setting = excluded.setting
 WHERE excluded.revision >= pair.revision"""
"""Writes rows, given as each engine gives values."""
COUNT = "UPDATE pair SET at_least = (SELECT count(*) - 1 FROM pair) WHERE (a, b) = (%s, %s)"
"""Notes in the mark's row how many other rows there are."""
HELD = "SELECT setting, revision FROM pair WHERE (a, b) = (%s, %s)"
MARK = (0, 1)
"""Key of the row that is no pair but the mark. No object has the id 0."""


class PairRow(NamedTuple):
    """What was found about two objects.

    a, b : ids, the lesser one first; kind : ``far`` beyond the distance of the search; at_least,
    at_most : metres, of the gap, or of the depth of an overlap, at_most None without a bound;
    place : x, y, z on a, then on b, metres, world frame; status : since the last complete search;
    revision : of the environment that was read; setting : of the search; because, shapes : why the
    pair is accepted, and both digests then, or None.
    """

    a: int
    b: int
    kind: Kind
    at_least: float
    at_most: float | None
    place: tuple[float, ...]
    status: Status
    revision: int
    setting: str
    because: str | None = None
    shapes: str | None = None

    @property
    def columns(self) -> tuple[object, ...]:
        """Values of `COLUMNS`."""
        return (*self[:5], *self.place, *self[6:9])


class Rule(NamedTuple):
    """Decision about pairs, by the words of their objects (`store.finding`).

    one, other : words, a comma between several; kinds : that are meant; length : metres, the
    greatest depth that is meant, None for any, or the clearance; because : why, may be empty.
    """

    one: str
    other: str
    says: Says
    kinds: tuple[Kind, ...] = ()
    length: float | None = None
    because: str = ""


class Mark(NamedTuple):
    """State of the table, so that a search need not look at pairs of unchanged objects again.

    After a search of everything, alone from its reading to its end: the setting and the revision
    of all pairs of near boxes. Otherwise a setting that nobody has given.
    """

    setting: str = ""
    revision: int = 0

    @classmethod
    def after(
        cls, found: Sequence[tuple[str, int]], was: "MaybeMark", now: "MaybeMark"
    ) -> tuple["MaybeMark", PairRow]:
        """What `put_pairs` returns, and the row that it writes; found : the mark's row, or none."""
        held = cls(*found[0]) if found else cls()
        mark = now if now is not None and held == was else cls(f"written {os.urandom(8).hex()}")
        row = PairRow(*MARK, Kind.FAR, 0.0, None, (0.0,) * 6, "same", mark.revision, mark.setting)
        return (mark if held == was else None), row


MaybeMark = Mark | None
Ids = Sequence[tuple[int, int]]
"""Ids of pairs, the lesser one first."""


class KeptPairs:
    """Rows of the table, read together, and each checked when it is used.

    rows : as the engine gave them, by a and b: `COLUMNS`, because and shapes; checked : makes a
    `PairRow` of one, or raises `DamagedError`.
    """

    def __init__(
        self, rows: Sequence[Sequence[Any]], checked: Callable[[Sequence[Any]], PairRow]
    ) -> None:
        has_mark = bool(rows) and rows[0][A] == MARK[0]
        row = checked(rows[0]) if has_mark else None
        self.mark = Mark() if row is None else Mark(row.setting, row.revision)
        self.rows, self._checked = rows[has_mark:], checked
        self._n_marked = 0 if row is None else row.at_least

    def fit(self, setting: str) -> bool:
        """Whether rows are as the mark's writer left them: so many, of that setting or accepted.

        Programs that know of no mark, and people, write without changing it.
        """
        return self._n_marked == len(self.rows) and all(
            row[SETTING] == setting or row[BECAUSE] is not None for row in self.rows
        )

    def __iter__(self) -> Iterator[PairRow]:
        return map(self._checked, self.rows)

    def parted(self, ids: Container[int]) -> tuple["KeptPairs", "KeptPairs"]:
        """Rows of pairs that one of these objects is in, and the other rows."""
        some = [row for row in self.rows if row[A] in ids or row[B] in ids]
        others = [row for row in self.rows if row[A] not in ids and row[B] not in ids]
        return KeptPairs(some, self._checked), KeptPairs(others, self._checked)

    def none(self) -> "KeptPairs":
        """No rows."""
        return KeptPairs((), self._checked)


class Outlines(NamedTuple):
    """What is short of O objects: names, digests, ids and revisions (O,), bounds (O, 2, 3)."""

    names: Sequence[str]
    digests: Sequence[str]
    ids: NDArray[np.int64]
    revisions: NDArray[np.int64]
    bounds: NDArray[np.float64]
