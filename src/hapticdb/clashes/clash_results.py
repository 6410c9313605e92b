"""Results of a search for clashes: metres, world frame."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

from hapticdb.clashes.rules import MEANT, Rules, parse_rule, rule_text
from hapticdb.errors import UsageError
from hapticdb.store.finding import NAME
from hapticdb.store.pairs import KIND, PairRow, Rule, Status, StoredPairs
from hapticdb.tabular.schema import plain
from hapticdb.tabular.tables import Columns, Tabular, columns_of
from hapticdb.units import length_text, notebook_html, volume_text
from hapticdb.verdicts import REPORTED, Kind

Shown = Literal[Status, "accepted", "meant", "not looked at"]
DEFAULT_KINDS = REPORTED[:4]
"""Default kinds of findings: what shares material with something else, or is too near it."""

PAIR_KEYS = (
    "a", "a_name", "b", "b_name", "kind", "at_least", "at_most", "places", "status", "because",
    "rule", "volume",
)  # fmt: skip
"""Keys of a pair's row."""
MOST_SHOWN = 20
"""Pairs in a notebook; more are counted. Larger: a longer table."""


class Clash(NamedTuple):
    """Two objects near one another.

    a, b : ids, the lesser one first; a_name, b_name : None of a removed object; kind : as in
    docs/clashes.md; at_least, at_most : metres, of the gap, or of the depth of an overlap, at_most
    None without a bound; place : x, y, z on a, then on b; status : since the last call; because :
    reason of an acceptance or a rule, or None; rule : number, from 1, of the deciding rule;
    volume : of an overlap, cubic metres, or None.
    """

    a: int
    b: int
    a_name: str | None
    b_name: str | None
    kind: Kind
    at_least: float
    at_most: float | None
    place: tuple[float, ...] | None
    status: Shown
    because: str | None = None
    rule: int | None = None
    volume: float | None = None

    @property
    def is_open(self) -> bool:
        """Whether the pair is present, and neither accepted nor meant by a rule."""
        return self.status not in {"gone", "accepted", "meant"}

    @property
    def is_unmeasured(self) -> bool:
        """Whether the pair was not measured."""
        return self.status == "not looked at"

    def length_text(self) -> str:
        """Write the gap, or the depth and the volume: exact, or a bound."""
        if self.volume is not None:
            return f"{self._replace(volume=None).length_text()}, {volume_text(self.volume)}"
        if self.is_unmeasured or self.status == "gone":
            return "-"
        at_least = length_text(self.at_least)
        if self.kind != Kind.OVERLAPPING:
            return at_least
        if not self.at_least:
            at_most = "" if self.at_most is None else f"up to {length_text(self.at_most)} "
            return f"{at_most}(how deep at least is not known)"
        if self.at_most is None:
            return f"{at_least} or more"
        return f"{at_least} to {length_text(self.at_most)}"


def rule_for(one: Clash) -> str:
    """Rule to mean a pair, up to a tenth more than its depth.

    Empty for a pair that is too near, and for names that a rule cannot hold.
    """
    if one.kind == Kind.TOO_NEAR or not one.a_name or not one.b_name:
        return ""
    depth = one.at_most if one.kind == Kind.OVERLAPPING else None
    kinds = MEANT if one.kind in MEANT else (one.kind,)
    names = (one.a_name, one.b_name)
    a, b = (NAME + name if re.fullmatch(r"[\d, ]+", name) else name for name in names)
    text = rule_text(Rule(a, b, "meant", kinds, depth and 1.1 * depth))
    try:
        return text if parse_rule(text)[:4] == (a, b, "meant", kinds) else ""
    except UsageError:
        return ""


Known = Mapping[int, tuple[str, str]]
"""Name and digest of each object, by its id."""


def shapes_of(known: Known, a: int, b: int) -> str | None:
    """Both shapes, as in an acceptance; None if an object is gone."""
    return f"{known[a][1]} {known[b][1]}" if a in known and b in known else None


def accepted(row: PairRow, known: Known) -> str | None:
    """Reason of an acceptance; None without one, or after a change of a shape."""
    return row.because if row.shapes == shapes_of(known, row.a, row.b) else None


def clash_of(row: PairRow, status: Status, known: Known) -> Clash:
    """Clash of a row."""
    because = None if status == "gone" else accepted(row, known)
    a_name, b_name = (known[i][0] if i in known else None for i in (row.a, row.b))
    return Clash(
        row.a, row.b, a_name, b_name, Kind.APART if status == "gone" else row.kind, row.at_least,
        row.at_most, row.place,
        status if because is None else "accepted", because,
    )  # fmt: skip


def reported(found: Sequence[Clash], rules: Rules) -> list[Clash]:
    """Pairs by the rules."""
    numbers = rules.first(one[:2] for one in found).tolist() if rules.rules else [-1] * len(found)
    return [
        one
        if n < 0 or one.status == "gone" or one.is_unmeasured
        else _decided(one._replace(rule=n + 1), rules.rules[n])
        for one, n in zip(found, numbers, strict=True)
    ]


def _decided(one: Clash, rule: Rule) -> Clash:
    """Pair by a rule."""
    length = math.inf if rule.length is None else rule.length
    if rule.says == "apart":
        is_near = one.at_least < length and one.kind not in {Kind.OVERLAPPING, Kind.DUPLICATE}
        return one._replace(kind=Kind.TOO_NEAR) if is_near else one
    depth = one.at_most if one.kind == Kind.OVERLAPPING else 0.0
    depth = math.inf if depth is None else depth  # a foil across a foil is shallow everywhere
    if one.kind not in rule.kinds or depth > length or one.status == "accepted":
        return one
    return one._replace(status="meant", because=rule.because or rule_text(rule))


class Reach(NamedTuple):
    """Reach of a rule.

    n_pairs : decided by it; n_changed : of them, meant, too near or ignored; missing : error of
    words without an object, or empty.
    """

    rule: Rule
    n_pairs: int
    n_changed: int
    missing: str

    def __str__(self) -> str:
        """Counts, or the reason of an empty reach."""
        if not self.n_pairs:
            return f"no pair{self.missing and f': {self.missing}'}"
        word = {"meant": "meant", "apart": "too near", "ignore": "ignored"}[self.rule.says]
        return f"{self.n_pairs:,} pair{'s' * (self.n_pairs > 1)}, {self.n_changed:,} {word}"


@dataclass(frozen=True)
class Clashes(Tabular):
    """Result of a search.

    current : pairs of this search; rest : rows of all other pairs, unchanged since the last call;
    known : all objects; measured, kept : numbers of pairs of near boxes measured now or before;
    rules : of the environment; ignored : ids of the pairs of near boxes ignored by a rule; left :
    not measured, for want of time or after a write to an object; within, contact : metres;
    revision : of the database; elapsed : seconds; is_kept : whether the database has the result.
    """

    current: tuple[Clash, ...]
    rest: StoredPairs
    known: Known
    rules: Rules
    ignored: tuple[tuple[int, int], ...]
    measured: int
    kept: int
    left: int
    within: float
    contact: float
    revision: int
    elapsed: float
    is_kept: bool

    def __repr__(self) -> str:
        found = ", ".join(f"{n} {kind}" for kind, n in self.counts().items() if n)
        return f"Clashes({found or 'no pairs'}, {self.elapsed:.2f} s)"

    def _repr_html_(self) -> str:
        """The gravest pairs, for notebooks."""
        shown = [one for one in self.pairs if one.is_open]
        rows = [(one.a_name, one.b_name, one.kind, one.length_text()) for one in shown[:MOST_SHOWN]]
        more = len(shown) - len(rows)
        return notebook_html(self, rows + [(f"and {more:,} more", "", "", "")] * (more > 0))

    def columns(self) -> Columns:
        """A row for each pair, the gravest first."""
        return columns_of(PAIR_KEYS, map(plain, self.pairs))

    @cached_property
    def pairs(self) -> tuple[Clash, ...]:
        """All pairs, the gravest first, and the deepest or nearest of each kind."""
        # when they are asked for: that takes as long as a search after one change (make clashes)
        rest = (clash_of(row, "same", self.known) for row in self.rest if row.kind != Kind.FAR)
        return tuple(sorted(reported((*self.current, *rest), self.rules), key=gravity))

    def reach(self) -> list[Reach]:
        """Reach of each rule."""
        ignored = (self.rules.first(self.ignored) + 1).tolist()
        reached, changed = Counter[int | None](ignored), Counter[int | None](ignored)
        for one in self.pairs:
            reached[one.rule] += 1
            changed[one.rule] += one.status == "meant" or one.kind == Kind.TOO_NEAR
        return [
            Reach(rule, reached[n], changed[n], missing)
            for n, (rule, missing) in enumerate(
                zip(self.rules.rules, self.rules.missing, strict=True), start=1
            )
        ]

    def of(self, kinds: tuple[Kind, ...] = DEFAULT_KINDS) -> tuple[Clash, ...]:
        """Open pairs of some kinds, and unmeasured ones."""
        return tuple(
            one for one in self.pairs if one.is_open and (one.kind in kinds or one.is_unmeasured)
        )

    def counts(self) -> dict[str, int]:
        """Numbers of present pairs by kind."""
        current = self.pairs if self.rules.rules else self.current
        found = Counter[str](one.kind for one in current if one.status != "gone")
        if not self.rules.rules:
            found.update(row[KIND] for row in self.rest.rows)
        return {kind: found[kind] for kind in REPORTED}

    def statuses(self) -> dict[str, int]:
        """Numbers of pairs by status."""
        return dict(Counter(one.status for one in self.pairs))


def gravity(one: Clash) -> tuple[int, float, int, int]:
    """Sort key: the gravest first."""
    size = -one.at_least if one.kind == Kind.OVERLAPPING else one.at_least
    return one.kind.gravity, size, one.a, one.b
