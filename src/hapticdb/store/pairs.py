"""Pairs of objects as the table `pair` keeps them, and what a store does with them."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol, get_args

Kind = Literal["apart", "touching", "overlapping", "inside", "not known", "far"]
Status = Literal["new", "gone", "changed", "same"]
KINDS: tuple[Kind, ...] = get_args(Kind)
STATUSES: tuple[Status, ...] = get_args(Status)

COLUMNS = "a, b, kind, at_least, at_most, a_x, a_y, a_z, b_x, b_y, b_z, status, revision, setting"
"""Columns of the table `pair` that a measurement writes."""
UNLESS_LATER = """
    ON CONFLICT (a, b) DO UPDATE
   SET kind = excluded.kind, at_least = excluded.at_least, at_most = excluded.at_most,
       a_x = excluded.a_x, a_y = excluded.a_y, a_z = excluded.a_z, b_x = excluded.b_x,
       b_y = excluded.b_y, b_z = excluded.b_z, status = excluded.status,
       revision = excluded.revision, setting = excluded.setting
 WHERE excluded.revision >= pair.revision"""
"""End of the statement, in each engine's dialect, that writes rows."""


class PairRow(NamedTuple):
    """What was found about two objects.

    a, b : ids, the lesser one first; kind : ``far`` for a pair that was looked at and is farther
    apart than was asked for; at_least, at_most : metres, of the gap, or of the depth of an overlap,
    at_most None where no bound is known; place : x, y, z on a, then on b, metres, world frame;
    status : since the last call that came to its end; revision : of the environment that was read;
    setting : what was asked for; because, shapes : why the pair is accepted, and both digests then;
    None where it is not.
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


class KeepsPairs(Protocol):
    """Keeps what was found about pairs of objects. It changes no revision."""

    def pairs(self) -> list[PairRow]:
        """All rows, ordered by a and b."""

    def put_pairs(self, rows: Sequence[PairRow], gone: Sequence[tuple[int, int]] = ()) -> None:
        """Write rows and delete others, in one transaction.

        Rows of a later revision than a given one stay, and so does what `accept_pair` has written.
        """

    def accept_pair(self, a: int, b: int, because: str | None, shapes: str | None) -> None:
        """Note why a pair is accepted, and the shapes of both; nothing if it has no row."""
