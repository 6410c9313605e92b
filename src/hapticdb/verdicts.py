"""Kinds of pairs of surfaces, and verdicts of paths, with their exit statuses."""

from collections.abc import Sequence
from enum import StrEnum
from typing import Self


class Kind(StrEnum):
    """Relation of two surfaces, the gravest first.

    DUPLICATE: equal ones at one pose; TOO_NEAR: nearer than a rule allows, never stored; FAR:
    beyond the distance of the search.
    """

    OVERLAPPING = "overlapping"
    DUPLICATE = "duplicate"
    TOO_NEAR = "too near"
    INSIDE = "inside"
    NOT_KNOWN = "not known"
    TOUCHING = "touching"
    APART = "apart"
    FAR = "far"

    @property
    def gravity(self) -> int:
        """Rank, 0 of the gravest."""
        return _GRAVITY[self]

    @property
    def is_free(self) -> bool:
        """Whether the surfaces at most touch."""
        return self in {Kind.TOUCHING, Kind.APART, Kind.FAR}


_GRAVITY = {kind: n for n, kind in enumerate(Kind)}
REPORTED = tuple(Kind)[:-1]
"""Kinds of pairs within the distance of a search."""


class PathVerdict(StrEnum):
    """Result of a sweep, an extraction or a disassembly, the worst of a batch first.

    exit_status : of the command line; line : its meaning.
    """

    exit_status: int
    line: str

    HITS = "hits", 1, "a surface is met, or the tool starts inside an object"
    NO_PATH = "no path found", 1, "one may exist"
    NO_ORDER = "no order found", 1, "one may exist"
    NOT_REACHABLE = "not reachable", 1, "each placement of the tool is blocked"
    NOT_DECIDED = "not decided", 3, "the time was over, or a chord error is too large"
    OVERLAPS = "overlaps", 4, "nothing else is hit, but it overlaps others at the start"
    CLEAR = "clear", 0, "nothing is hit"
    SLIDES = "slides", 0, "nothing is hit, but it moves in contact"
    REACHABLE = "reachable", 0, "a placement of the tool is free"
    COMES_OUT = "comes out", 0, "nothing is hit, nor touched at the end of the path"

    def __new__(cls, text: str, exit_status: int, line: str) -> Self:
        """Verdict of that text."""
        member = str.__new__(cls, text)
        member._value_ = text
        member.exit_status, member.line = exit_status, line
        return member

    @property
    def is_free(self) -> bool:
        """Whether the whole path is free, but for overlaps at the start."""
        return self.exit_status in {0, PathVerdict.OVERLAPS.exit_status}


def exit_codes(verdicts: Sequence[PathVerdict], many: str = "") -> str:
    """Exit status of each verdict with its meaning, for help texts; many : subject of a batch."""
    found = "; ".join(f"{one.exit_status} {one}, {one.line}" for one in verdicts)
    codes = {one.exit_status for one in verdicts}
    worst = " before ".join(str(code) for code in WORST if code in codes)
    return f"Exit codes: {found}." + (f" {many} the worst: {worst}." if many else "")


SWEEP_VERDICTS = (
    PathVerdict.CLEAR, PathVerdict.SLIDES, PathVerdict.OVERLAPS, PathVerdict.NOT_DECIDED,
    PathVerdict.HITS,
)  # fmt: skip
EXTRACT_VERDICTS = (PathVerdict.COMES_OUT, *SWEEP_VERDICTS[1:-1], PathVerdict.NO_PATH)
REACH_VERDICTS = (PathVerdict.REACHABLE, PathVerdict.NOT_DECIDED, PathVerdict.NOT_REACHABLE)
"""Verdicts of sweeps, of extractions and disassemblies, and of tools' reach."""
WORST = tuple(dict.fromkeys(verdict.exit_status for verdict in PathVerdict))
"""Exit statuses, the worst first: a batch has the first of them among its sweeps."""
