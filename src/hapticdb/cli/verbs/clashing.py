"""The verb clashes."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

import hapticdb
from hapticdb.cli import render
from hapticdb.cli.emit import TableOutput, new_files, open_csv
from hapticdb.cli.selection import opened_to_store
from hapticdb.cli.values import MIB, Point, refuse
from hapticdb.errors import UsageError
from hapticdb.tabular.schema import AXES, plain
from hapticdb.units import length_text, place_text
from hapticdb.verdicts import REPORTED, Kind

if TYPE_CHECKING:
    from hapticdb.clashes.clash_results import Clash, Clashes
    from hapticdb.clashes.groups import Group
    from hapticdb.environment import Environment
    from hapticdb.exact.moving_clash import Meeting

NOT_DECIDED = 3
"""Exit code of a search without a clash, but with pairs not yet measured."""
MEETINGS = ("id", "name", "begin", "end", "kind", "at_least", "place")
"""Keys with --poses or --turn: a row for each meeting, in the order of the motion."""

HELP = """Find the parts that overlap, touch or are near.

Apart: farther than --contact. Touching: within --contact, or freed by a motion of so much.
Overlapping: deeper. Inside: one lies in a closed body of the other. Not known: point clouds, which
have no surface. The triangles decide.

The database keeps what is found. The next call measures only pairs of objects that were added,
moved or replaced since, and says what is new, changed, gone or the same. --accept marks pairs as
intended, until either part changes its shape.

Pairs are reported in groups, each one finding: copies of a pair, one part against many, and
duplicates, which are equal parts at one place. The table has open groups alone; --all and --group
list pairs. --rules and --rule say what is meant, what to keep apart, and what to ignore; the
database keeps them, and the first rule that reaches a pair decides.

--least-volume measures the volume that two closed parts have in common, and drops smaller ones. Of
open surfaces it is not known; such pairs stay.

Ctrl-C and --seconds lose nothing: the next call goes on. Pairs that were not measured are counted.

--poses and --turn move the parts of --of together, and say in which intervals of the motion they
meet each other object, and how deep. Where they do not is proved, as by sweep. Numbers are those of
poses, from 0, or degrees. Nothing of it is kept.

The exit code is 1 when a pair of a --kind was found that is neither accepted nor meant, 3 when
there is none but not all pairs were looked at, and else 0.

Example: hapticdb clashes car.db --of 'wheel*' --within 2
"""


@dataclass(frozen=True)
class PairOptions:
    """Options of the search for pairs."""

    within: float = 1e-3
    contact: float = 5e-5
    of: list[str] | None = None
    against: list[str] | None = None
    kind: list[str] | None = None
    seconds: float | None = None
    budget: int = 256 * MIB
    on: str | None = None

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Kinds of ``--kind``; UsageError for an unknown one."""
        names = self.kind or ()
        for name in names:
            if name not in REPORTED:
                raise UsageError(f"--kind {name!r}: give one of {', '.join(sorted(REPORTED))}")
        return tuple(kind for kind in REPORTED if kind in names)


@dataclass(frozen=True)
class RuleOptions:
    """Options of intended pairs: rules, acceptance; and of the choice of results."""

    accept: tuple[str, str] | None = None
    because: str | None = None
    rules: str | None = None
    rule: list[str] | None = None
    group: str | None = None
    all_: bool = False
    least_volume: float | None = None


@dataclass(frozen=True)
class TurnOptions:
    """Options of a motion."""

    poses: str | None = None
    turn: str | None = None
    about: Point | None = None
    from_: float = 0.0
    to: float = 90.0


@dataclass(frozen=True)
class _Output(TableOutput):
    html: str | None = None
    junit: str | None = None
    bcf: str | None = None


def clashes(
    url: str, *, pairs: PairOptions, meant: RuleOptions, motion: TurnOptions, output: _Output
) -> None:
    """See `HELP`."""
    because, kinds = meant.because, pairs.kinds
    if because is not None:
        refuse("with --because", output, "csv html junit bcf")
        refuse("with --because", motion)
    if meant.accept is not None or (because is not None and meant.group is None):
        refuse("with --accept", pairs)
        refuse("with --accept", meant, "rules rule group all_ least_volume")
        if meant.accept is None or because is None:
            raise UsageError("--accept A B and --because TEXT: give both, or neither")
        a, b = meant.accept
        with hapticdb.open(url) as env:
            rows = hapticdb.accept_clash(env, [a], [b], because or None)
        _say_accepted([(row.a, row.b) for row in rows], because, output)
        return
    if motion.poses is not None or motion.turn is not None:
        refuse("with --poses or --turn", pairs, "within seconds budget on")
        refuse("with --poses or --turn", meant)
        refuse("with --poses or --turn", output, "html junit bcf")
        _moved(url, pairs, motion, output)
    refuse("without --poses or --turn", motion)
    from hapticdb.clashes.clash_results import DEFAULT_KINDS, PAIR_KEYS
    from hapticdb.clashes.rules import add_rules
    from hapticdb.clashes.search import accept_pairs

    with (
        open_csv(output.csv, (*PAIR_KEYS, "group")) as table,
        new_files(html=output.html, junit=output.junit, bcf=output.bcf) as files,
        opened_to_store(url) as env,
    ):
        add_rules(env.store, meant.rule or (), pairs.within, meant.rules)
        with render.bar("measuring", "pairs") as progress:
            found = hapticdb.find_clashes(
                env, within=pairs.within, contact=pairs.contact, of=pairs.of or (),
                against=pairs.against or (), on=pairs.on, seconds=pairs.seconds,
                budget=pairs.budget, progress=progress)  # fmt: skip
        with env.store.snapshot():  # others may remove objects meanwhile
            if meant.least_volume is not None:
                from hapticdb.clashes.volumes import with_volumes

                found = with_volumes(env.store, found, meant.least_volume)
            findings = _Findings.of(env, found, kinds, meant.group)
            if files:
                from hapticdb.pictures.reports import write_reports

                write_reports(files, env, found, findings.pairs, findings.groups, kinds)
        if because is not None:
            accept_pairs(env.store, [*findings.ids], found.known, because or None)
            _say_accepted([*findings.ids], because, output)
            return
        if table is not None:
            table.add(*findings.records())
    findings.say(url, output, is_grouped=meant.group is None and not meant.all_)
    if any(not one.is_unmeasured for one in found.of(kinds or DEFAULT_KINDS)):
        raise typer.Exit(1)
    raise typer.Exit(NOT_DECIDED if found.left else 0)


clashes.__doc__ = HELP


class _Findings(NamedTuple):
    """Printed results of a search; ids : of groups, by pairs of object ids."""

    found: "Clashes"
    pairs: "list[Clash]"
    groups: "list[Group]"
    ids: dict[tuple[int, int], str]

    @classmethod
    def of(
        cls, env: "Environment", found: "Clashes", kinds: tuple[Kind, ...], group: str | None
    ) -> "_Findings":
        """Pairs of some kinds, or of one group; UsageError for an unknown group."""
        from hapticdb.clashes.groups import groups_of

        pairs = [one for one in found.pairs if not kinds or one.kind in kinds or one.is_unmeasured]
        groups = groups_of(env.store, pairs)
        if group is not None:
            groups = [one for one in groups if one.id == group]
            pairs = [one for found in groups for one in found.pairs]
            if not pairs:
                raise UsageError(f"--group {group!r}: none; the table without --group lists them")
        ids = {(one.a, one.b): found.id for found in groups for one in found.pairs}
        return cls(found, pairs, groups, ids)

    def records(self) -> Iterator[dict[str, Any]]:
        """Records of the pairs, with their groups."""
        for one in self.pairs:
            yield plain(one) | {"group": self.ids.get((one.a, one.b))}

    def say(self, url: str, output: _Output, *, is_grouped: bool) -> None:
        """Print groups or pairs, and the reach of the rules."""
        if output.json:
            output.add(None, *self.records())
        if output.has_words:
            _show_groups(self.groups) if is_grouped else _show_pairs(self.pairs)
            _show_facts(self.found, self.groups)
        else:
            for n, reach in enumerate(self.found.reach(), start=1):
                if not reach.n_pairs:
                    render.note(f"rule {n} reaches {reach}")
        if not self.found.is_kept:
            render.note(f"{url} can only be read by this user: what was found is not kept")


def _moved(url: str, pairs: PairOptions, motion: TurnOptions, output: _Output) -> None:
    """Print the meetings of moving parts with others, and exit."""
    from hapticdb.clashes.clash_results import DEFAULT_KINDS

    kinds = pairs.kinds
    with open_csv(output.csv, MEETINGS) as table:
        findings = [one for one in _meetings(url, pairs, motion) if not kinds or one.kind in kinds]
        output.add(table, *map(plain, findings))
    if output.has_words:
        rows = [(one.id, one.name, f"{one.begin:.4g}", f"{one.end:.4g}", one.kind,
                 length_text(one.at_least) if one.at_least else "-")
                for one in findings]  # fmt: skip
        unit = "pose" if motion.turn is None else "degrees"
        render.table(("id>", "object", f"from {unit}>", "to>", "are", "by at least>"), rows)
        render.say(f"{render.counted(len(findings), 'meeting')} on the way")
    raise typer.Exit(int(any(one.kind in (kinds or DEFAULT_KINDS) for one in findings)))


def _meetings(url: str, pairs: PairOptions, motion: TurnOptions) -> "list[Meeting]":
    """Meetings of moving parts with others, as intervals of pose numbers or degrees."""
    from hapticdb.exact.moving_clash import find_meetings, hinge
    from hapticdb.poses import read_poses
    from hapticdb.store.attributes import scene_bounds

    poses, turn, about, of = motion.poses, motion.turn, motion.about, pairs.of or []
    if (poses is None) == (turn is None) or turn not in {None, *AXES} or not of:
        raise UsageError("give --of, and either --poses CSV, or --turn x, y or z")
    if poses is not None:
        refuse("with --poses", motion, "from_ to")
    with (
        hapticdb.open(url, read_only=True) as env,
        render.bar("moving", "objects") as progress,
    ):
        if poses is not None:
            placed = read_poses(poses)
        else:
            bounds = scene_bounds(env.find(*of))
            assert bounds is not None  # noqa: S101 - words choose something
            about = Point(*bounds.mean(axis=0).tolist()) if about is None else about
            placed = hinge(AXES.index(turn or "x"), about, motion.from_, motion.to)
        found = find_meetings(
            env, of, placed, about=about, against=pairs.against or (), contact=pairs.contact,
            progress=progress,
        )  # fmt: skip
    if turn is None:
        return found
    begin, step = motion.from_, (motion.to - motion.from_) / (len(placed) - 1)
    return [
        one._replace(begin=begin + step * one.begin, end=begin + step * one.end) for one in found
    ]


def _say_accepted(pairs: list[tuple[int, int]], because: str, output: _Output) -> None:
    output.add(None, *({"a": a, "b": b, "because": because or None} for a, b in pairs))
    if not output.json:
        what = "accepted until a part changes its shape" if because else "no longer accepted"
        render.say(f"{render.counted(len(pairs), 'pair')} {what}")


def _show_groups(groups: "list[Group]") -> None:
    """Print the gravest open groups, and the number of closed ones."""
    shown = [one for one in groups if one.is_open]
    rows = (
        (one.id, one.kind, f"{len(one.pairs):,}", f"{one.n_parts:,}", one.length_text(),
         place_text((1e3 * x for x in place[:3]), 0.1) if place else "", one.status(), one.title())
        for one in shown
        for place in [one.pairs[0].place]
    )  # fmt: skip
    headings = ("group>", "are", "pairs>", "parts>?", "by>", "at, mm?", "status", "which")
    render.table(headings, rows, len(shown), "groups; --csv writes all pairs")
    if len(shown) < len(groups):
        count = render.counted(len(groups) - len(shown), "group")
        render.say(f"{count} meant or accepted: --all shows all pairs")


def _show_pairs(findings: "list[Clash]") -> None:
    """Print the gravest pairs."""
    rows = (
        (one.a, one.a_name or "(gone)", one.b, one.b_name or "(gone)", one.kind,
         one.length_text(), one.because or one.status)
        for one in findings
    )  # fmt: skip
    headings = ("id>", "object", "id>", "and", "are", "by>", "status")
    render.table(headings, rows, len(findings), "pairs; --csv writes all")


def _show_facts(found: "Clashes", groups: "list[Group]") -> None:
    """Print the reach of each rule, and the numbers of groups and pairs of each kind."""
    from hapticdb.clashes.rules import rule_text

    reached = ((n, rule_text(one.rule), one) for n, one in enumerate(found.reach(), start=1))
    render.table(("rule>", "says", "reaches"), reached)
    counts = ", ".join(f"{n:,} {kind}" for kind, n in found.counts().items() if n)
    statuses = ", ".join(f"{n:,} {status}" for status, n in sorted(found.statuses().items()))
    kinds = Counter[str](group.kind for group in groups if group.is_open)
    open_ones = ", ".join(f"{kinds[kind]:,} {kind}" for kind in REPORTED if kinds[kind])
    facts = [("open groups", open_ones or "none")]
    facts.append((f"pairs within {length_text(found.within)}", counts or "none"))
    if statuses:
        facts.append(("since the last call", statuses))
    measured, left = (render.counted(n, "pair") for n in (found.measured, found.left))
    facts.append(("measured", f"{measured}, {found.kept:,} known before"))
    if found.left:
        facts.append(("not looked at", f"{left}: call again to go on"))
    if found.ignored:
        ignored = render.counted(len(found.ignored), "pair")
        facts.append(("ignored", f"{ignored} of near boxes, by rules: not measured"))
    facts.append(("took", f"{found.elapsed:.2f} s"))
    render.facts(facts)
