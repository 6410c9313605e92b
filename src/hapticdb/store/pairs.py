"""Rows of the table `pair`, rules, and summary rows of objects."""

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
"""Columns of the table `pair` written by a measurement."""
ALL = f"SELECT {COLUMNS}, because, shapes FROM pair ORDER BY a, b"
A, B, KIND, SETTING, BECAUSE = map(
    [*COLUMNS.split(", "), "because"].index, ("a", "b", "kind", "setting", "because")
)
"""Indices of columns in a row of `ALL`."""
PUT = f"""
INSERT INTO pair ({COLUMNS}) {{values}}
    ON CONFLICT (a, b) DO UPDATE
   SET kind = excluded.kind, at_least = excluded.at_least, at_most = excluded.at_most,
       a_x = excluded.a_x, a_y = excluded.a_y, a_z = excluded.a_z, b_x = excluded.b_x,
       b_y = excluded.b_y, b_z = excluded.b_z, status = excluded.status,
       revision = excluded.revision, setting = excluded.setting
 WHERE excluded.revision >= pair.revision"""
"""Writes rows; `values` in an engine's own form."""
COUNT = "UPDATE pair SET at_least = (SELECT count(*) - 1 FROM pair) WHERE (a, b) = (%s, %s)"
"""Stores the number of other rows in the mark's row."""
MARKED = "SELECT setting, revision FROM pair WHERE (a, b) = (%s, %s)"
MARK = (0, 1)
"""Key of the mark's row, which is no pair. No object has the id 0."""


class PairRow(NamedTuple):
    """Result of the narrow phase for two objects.

    a, b : ids, the lesser one first; kind : ``far`` beyond the distance of the search; at_least,
    at_most : metres, of the gap, or of the penetration depth, at_most None without a bound; place :
    x, y, z on a, then on b, metres, world frame; status : since the last complete search;
    revision : of the environment read; setting : of the search; because, shapes : reason of an
    accepted pair, and both digests then, or None.
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
    """Rule for pairs, by the words of their objects (`store.finding`).

    one, other : words, a comma between several; kinds : the accepted ones; length : metres, the
    greatest accepted depth, None for any, or the clearance; because : reason, may be empty.
    """

    one: str
    other: str
    says: Says
    kinds: tuple[Kind, ...] = ()
    length: float | None = None
    because: str = ""


class Mark(NamedTuple):
    """State of the table, so that a search can skip pairs of unchanged objects.

    After a search of everything, without other writes from its reading to its end: the setting and
    revision of all pairs of near boxes. Otherwise a random setting.
    """

    setting: str = ""
    revision: int = 0

    @classmethod
    def after(
        cls, found: Sequence[tuple[str, int]], was: "MaybeMark", now: "MaybeMark"
    ) -> tuple["MaybeMark", PairRow]:
        """Result of `put_pairs`, and its row of the mark; found : the present row, or none."""
        # compare and swap: another writer since the read has replaced the mark;
        # then no mark is true, and a random one forces the next search to look at all
        found_mark = cls(*found[0]) if found else cls()
        mark = (
            now if now is not None and found_mark == was else cls(f"written {os.urandom(8).hex()}")
        )
        row = PairRow(*MARK, Kind.FAR, 0.0, None, (0.0,) * 6, "same", mark.revision, mark.setting)
        return (mark if found_mark == was else None), row


MaybeMark = Mark | None
Ids = Sequence[tuple[int, int]]
"""Ids of pairs, the lesser one first."""


class StoredPairs:
    """Rows of the table from one read, each checked on use.

    rows : from the engine, by a and b: `COLUMNS`, because and shapes; checked : converts one to a
    `PairRow`, or raises `DamagedError`.
    """

    def __init__(
        self, rows: Sequence[Sequence[Any]], checked: Callable[[Sequence[Any]], PairRow]
    ) -> None:
        # ordered by (a, b): the mark's key sorts before every pair
        has_mark = bool(rows) and rows[0][A] == MARK[0]
        row = checked(rows[0]) if has_mark else None
        self.mark = Mark() if row is None else Mark(row.setting, row.revision)
        self.rows, self._checked = rows[has_mark:], checked
        self._n_marked = 0 if row is None else row.at_least

    def fit(self, setting: str) -> bool:
        """Whether the rows are unchanged since the mark: same number, same setting or accepted.

        Programs without marks, and people, write without changing it.
        """
        return self._n_marked == len(self.rows) and all(
            row[SETTING] == setting or row[BECAUSE] is not None for row in self.rows
        )

    def __iter__(self) -> Iterator[PairRow]:
        return map(self._checked, self.rows)

    def parted(self, ids: Container[int]) -> tuple["StoredPairs", "StoredPairs"]:
        """Rows of pairs with one of these objects, and the other rows."""
        some = [row for row in self.rows if row[A] in ids or row[B] in ids]
        others = [row for row in self.rows if row[A] not in ids and row[B] not in ids]
        return StoredPairs(some, self._checked), StoredPairs(others, self._checked)

    def none(self) -> "StoredPairs":
        """The same without rows."""
        return StoredPairs((), self._checked)


class Outlines(NamedTuple):
    """Summary rows of O objects: ids and revisions (O,), bounds (O, 2, 3) in metres."""

    names: Sequence[str]
    digests: Sequence[str]
    ids: NDArray[np.int64]
    revisions: NDArray[np.int64]
    bounds: NDArray[np.float64]
