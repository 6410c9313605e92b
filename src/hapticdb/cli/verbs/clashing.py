"""The verb clashes."""

from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

import hapticdb
from hapticdb.cli import render
from hapticdb.cli.choosing import opened_to_keep
from hapticdb.cli.csv_files import AXES, STDOUT, CsvWriter, new_files, open_csv, text_cell
from hapticdb.cli.options import (
    ClusterOption,
    CsvOption,
    JsonOption,
    UrlArgument,
    length_option,
)
from hapticdb.cli.values import Point, budget_bytes, point_of
from hapticdb.errors import UsageError
from hapticdb.units import length_text, place_text, volume_of
from hapticdb.verdicts import REPORTED, Kind

if TYPE_CHECKING:
    from collections.abc import Callable

    from hapticdb.clashes.groups import Group
    from hapticdb.clashes.result import Clash, Clashes
    from hapticdb.environment import Environment
    from hapticdb.exact.moving_clash import Meeting

MOST_ROWS = 20
"""Rows of the table; further ones are counted below it."""
NOT_DECIDED = 3
"""Exit code where nothing was found, but not all pairs were looked at."""
COLUMNS = (
    "a_id", "a_name", "b_id", "b_name", "kind", "at_least_m", "at_most_m", "a_x_m", "a_y_m",
    "a_z_m", "b_x_m", "b_y_m", "b_z_m", "status", "because", "rule", "volume_m3", "group",
)  # fmt: skip
"""Columns of `clashes --csv`: a row for each pair, the gravest first."""
MEETING_COLUMNS = ("id", "name", "begin", "end", "kind", "at_least_m", "x_m", "y_m", "z_m")
"""Columns with --poses or --turn: a row for each meeting, in the order of the motion."""

WithinOption = Annotated[float, length_option("pairs that are so near are told.", "1")]
ContactOption = Annotated[
    float,
    length_option("surfaces so near, or so little one in the other, touch.", "0.05"),
]
OfOption = Annotated[
    list[str] | None,
    typer.Option(metavar="WORDS", help="One of each pair; chosen as for 'hapticdb objects'."),
]
AgainstOption = Annotated[
    list[str] | None, typer.Option(metavar="WORDS", help="The other one of each pair, likewise.")
]
KindOption = Annotated[
    list[str] | None,
    typer.Option(
        "--kind",
        metavar="KIND",
        help="Kinds that are told, and that exit code 1 stands for. Give it again for more.",
        show_default="all are told; overlapping, duplicate, too near and inside give exit code 1",
    ),
]
SecondsOption = Annotated[
    float | None,
    typer.Option(metavar="S", help="Time of the search; the next call goes on.",
                 show_default="no limit"),
]  # fmt: skip
BudgetOption = Annotated[float, typer.Option(metavar="MIB", help="Memory for shapes.")]
AcceptOption = Annotated[
    tuple[str, str] | None,
    typer.Option(
        "--accept", metavar="A B", help="Accept the known pairs of these objects, with --because."
    ),
]
BecauseOption = Annotated[
    str | None, typer.Option(metavar="TEXT", help="Why --accept accepts; '' takes it back.")
]
RulesOption = Annotated[
    str | None,
    typer.Option(metavar="TOML", help="Rules of the database from now on, instead of its own."),
]
RuleOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TEXT", help="One more: 'bolts/* in *: overlap up to 0.3 mm is meant because ...'."
    ),
]
GroupOption = Annotated[
    str | None,
    typer.Option(metavar="ID", help="Pairs of one group; with --because, accept them."),
]
LeastVolumeOption = Annotated[
    float | None,
    typer.Option(
        metavar="VOLUME", parser=volume_of,
        help="Cubic centimetres, or such as 5mm3: volumes of overlaps, without smaller ones.",
        show_default="none is computed",
    ),
]  # fmt: skip
AllOption = Annotated[bool, typer.Option("--all", help="A table of pairs, not of groups.")]
HtmlOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE", help="Write a page with pictures, a matrix and the table to a new file."
    ),
]
JunitOption = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Write findings and rules as JUnit test cases, for CI."),
]
BcfOption = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Write findings as topics of BCF 2.1, such as hall.bcfzip."),
]
PosesOption = Annotated[
    str | None,
    typer.Option(
        metavar="CSV",
        help="Displacements x,y,z,qw,qx,qy,qz of --of, metres: say when it meets what.",
    ),
]
TurnOption = Annotated[
    str | None,
    typer.Option(metavar="AXIS", help="Instead: turn --of about x, y or z, as on a hinge."),
]
AboutOption = Annotated[
    Point | None,
    length_option(
        "a point of the hinge, or the centre of turns, scene's frame.",
        "middle of --of",
        parse=point_of,
    ),
]
FromOption = Annotated[
    float, typer.Option("--from", metavar="DEG", help="Degrees: start of --turn.")
]
ToOption = Annotated[float, typer.Option("--to", metavar="DEG", help="Degrees: end of --turn.")]

HELP = """Say which parts meet, how deep, and which are near: every pair of an assembly.

Apart: farther than --contact. Touching: within --contact, or freed by a motion of
so much. Overlapping: deeper. Inside: one lies in a closed body of the other. Not
known: point clouds, which have no surface. The triangles decide.

The database keeps what is found. The next call measures only pairs of objects
that were added, moved or replaced since, and says what is new, changed, gone or the
same. --accept marks pairs as intended, until either part changes its shape.

Pairs are told in groups, each one finding: copies of a pair, one part against many,
and duplicates, which are equal parts at one place. --all and --group tell pairs.
--rules and --rule say what is meant, what to keep apart, and what to ignore; the
database keeps them, and the first rule that reaches a pair decides.

--least-volume tells the volume that two closed parts have in common, and leaves out
smaller ones. Of open surfaces it is not known; such pairs stay.

Ctrl-C and --seconds lose nothing: the next call goes on. What was not looked
at is told as that.

--poses and --turn move the parts of --of together, and say in which intervals of the
motion they meet each other object, and how deep. Where they do not is proved, as by
sweep. Numbers are those of poses, from 0, or degrees. Nothing of it is kept.

--html, --junit and --bcf write reports: a page, test cases for CI, and topics for
the tools that made an IFC file, whose GlobalIds they carry.

The exit code is 1 when a pair of a --kind was found that is neither accepted nor
meant, 3 when there is none but not all pairs were looked at, and else 0.

Example: hapticdb clashes car.db --of 'wheel*' --within 2
"""


def clashes(
    url: UrlArgument,
    *,
    within: WithinOption = 1e-3,
    contact: ContactOption = 5e-5,
    of: OfOption = None,
    against: AgainstOption = None,
    kind: KindOption = None,
    seconds: SecondsOption = None,
    budget: BudgetOption = 256.0,
    on: ClusterOption = None,
    accept: AcceptOption = None,
    because: BecauseOption = None,
    rules: RulesOption = None,
    rule: RuleOption = None,
    group: GroupOption = None,
    all_: AllOption = False,
    least_volume: LeastVolumeOption = None,
    csv: CsvOption = None,
    html: HtmlOption = None,
    junit: JunitOption = None,
    bcf: BcfOption = None,
    poses: PosesOption = None,
    turn: TurnOption = None,
    about: AboutOption = None,
    from_: FromOption = 0.0,
    to: ToOption = 90.0,
    json: JsonOption = False,
) -> None:
    """Find every pair of objects that are near; the help text is `HELP`."""
    _check_outputs(csv, json=json)
    if because is not None and (csv or html or junit or bcf or (accept and (rules or rule))):
        raise UsageError("--because writes no report, and --accept takes no rules: leave them out")
    if accept is not None or (because is not None and group is None):
        raise typer.Exit(_accept(url, accept, because, json=json))
    kinds = _checked(kind)
    if poses is not None or turn is not None:
        if any((html, junit, bcf, seconds, on, rules, rule, group)) or not of:
            raise UsageError("--poses and --turn: give --of; no report, rule, --seconds, --on")
        motion = partial(_meetings, url, of, poses, turn, about, from_, to, against, contact)
        raise typer.Exit(_moved(motion, turn, kinds, csv, json=json))
    from hapticdb.clashes.rules import add_rules

    with (
        open_csv(csv, "--csv", COLUMNS) as table,
        new_files(html=html, junit=junit, bcf=bcf) as files,
        opened_to_keep(url) as env,
        render.bar("measuring", "pairs") as progress,
    ):
        add_rules(env.store, rule or (), within, rules)
        found = hapticdb.find_clashes(
                env, within=within, contact=contact, of=of or (), against=against or (), on=on,
                seconds=seconds, budget=budget_bytes(budget), progress=progress)  # fmt: skip
        with env.store.snapshot():  # others may remove objects meanwhile
            told = _Told.of(env, _with_volumes(env, least_volume, found), kinds, group)
            told.write(env, kinds, table, files)
        if because is not None:
            raise typer.Exit(told.accept(env, because, json=json))
    told.say(url, json=json, is_table=csv != STDOUT, is_grouped=group is None and not all_)
    raise typer.Exit(_exit_code(told.found, kinds))


def _check_outputs(csv: str | None, *, json: bool) -> None:
    if csv == STDOUT and json:
        raise UsageError("--csv - and --json: only one may be standard output")


def _with_volumes(env: "Environment", least: float | None, found: "Clashes") -> "Clashes":
    if least is None:
        return found
    from hapticdb.clashes.volumes import with_volumes

    return with_volumes(env.store, found, least)


class _Told(NamedTuple):
    """What is said of a search; ids : of the groups of pairs of object ids."""

    found: "Clashes"
    pairs: "list[Clash]"
    groups: "list[Group]"
    ids: dict[tuple[int, int], str]

    @classmethod
    def of(
        cls, env: "Environment", found: "Clashes", kinds: "tuple[Kind, ...]", group: str | None
    ) -> "_Told":
        """Pairs of some kinds, or of one group; UsageError where there is no such group."""
        from hapticdb.clashes.groups import groups_of

        pairs = [one for one in found.pairs if not kinds or one.kind in kinds or one.is_left]
        groups = groups_of(env.store, pairs)
        if group is not None:
            groups = [one for one in groups if one.id == group]
            pairs = [one for found in groups for one in found.pairs]
            if not pairs:
                raise UsageError(f"--group {group!r}: none; the table without --group lists them")
        ids = {(one.a, one.b): found.id for found in groups for one in found.pairs}
        return cls(found, pairs, groups, ids)

    def accept(self, env: "Environment", because: str, *, json: bool) -> int:
        """Accept the pairs, or take it back; returns the exit code."""
        from hapticdb.clashes.run import accept_pairs

        pairs = [(one.a, one.b) for one in self.pairs]
        accept_pairs(env.store, pairs, self.found.known, because or None)
        return _say_accepted(pairs, because, json=json)

    def write(
        self, env: "Environment", kinds: "tuple[Kind, ...]", table: CsvWriter | None,
        files: dict[str, Path],
    ) -> None:  # fmt: skip
        """Write the pairs as a table, a page and reports, where files are given."""
        if table:
            table.write(_row(one, self.ids.get((one.a, one.b))) for one in self.pairs)
        if files:
            from hapticdb.pictures.reports import write_reports

            write_reports(files, env, self.found, self.pairs, self.groups, kinds)

    def say(self, url: str, *, json: bool, is_table: bool, is_grouped: bool) -> None:
        """Print groups or pairs, and what rules reach."""
        for one in self.pairs if json else ():
            render.say_json(one._asdict() | {"group": self.ids.get((one.a, one.b))})
        if is_table and not json:
            _show_groups(self.groups) if is_grouped else _show_pairs(self.pairs)
            _show_facts(self.found, self.groups)
        else:
            for n, reach in enumerate(self.found.reach(), start=1):
                if not reach.n_pairs:
                    render.note(f"rule {n} reaches {reach}")
        if not self.found.is_kept:
            render.note(f"{url} can only be read by this user: what was found is not kept")


def _moved(
    motion: "Callable[[], list[Meeting]]", turn: str | None, kinds: "tuple[Kind, ...]",
    csv: str | None, *, json: bool,
) -> int:  # fmt: skip
    """Print when parts that move meet others; returns the exit code."""
    from hapticdb.clashes.result import ASKED

    with open_csv(csv, "--csv", MEETING_COLUMNS) as table:
        told = [one for one in motion() if not kinds or one.kind in kinds]
        if table:
            table.write([one.id, text_cell(one.name), *one[2:6], *one.place] for one in told)
    if json:
        for one in told:
            render.say_json(one._asdict())
    elif csv != STDOUT:
        rows = [(str(one.id), one.name, f"{one.begin:.4g}", f"{one.end:.4g}", one.kind,
                 length_text(one.at_least) if one.at_least else "-") for one in told]  # fmt: skip
        unit = "pose" if turn is None else "degrees"
        if rows:
            render.table(("id>", "object", f"from {unit}>", "to>", "are", "by at least>"), rows)
        render.say(f"{render.counted(len(told), 'meeting')} on the way")
    return int(any(one.kind in (kinds or ASKED) for one in told))


def _meetings(
    url: str, of: list[str], poses: str | None, turn: str | None, about: Point | None,
    begin: float, end: float, against: list[str] | None, contact: float,
) -> "list[Meeting]":  # fmt: skip
    """When parts that move meet others: numbers of poses, or degrees."""
    from hapticdb.exact.moving_clash import find_meetings, hinge
    from hapticdb.poses import read_poses
    from hapticdb.store.attributes import scene_bounds

    if (poses is None) == (turn is None) or turn not in {None, *AXES}:
        raise UsageError("give either --poses CSV, or --turn x, y or z")
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
            placed = hinge(AXES.index(turn or "x"), about, begin, end)
        found = find_meetings(
                env, of, placed, about=about, against=against or (), contact=contact,
                progress=progress,
            )  # fmt: skip
    if turn is None:
        return found
    step = (end - begin) / (len(placed) - 1)
    return [
        one._replace(begin=begin + step * one.begin, end=begin + step * one.end) for one in found
    ]


def _exit_code(found: "Clashes", kinds: "tuple[Kind, ...]") -> int:
    if any(not one.is_left for one in (found.of(kinds) if kinds else found.of())):
        return 1
    return NOT_DECIDED if found.left else 0


def _checked(names: list[str] | None) -> "tuple[Kind, ...]":
    """Kinds of the names given; UsageError."""
    for name in names or ():
        if name not in REPORTED:
            raise UsageError(f"--kind {name!r}: give one of {', '.join(sorted(REPORTED))}")
    return tuple(kind for kind in REPORTED if kind in (names or ()))


def _accept(url: str, pair: tuple[str, str] | None, because: str | None, *, json: bool) -> int:
    from hapticdb.clashes.run import accept_clash

    if pair is None or because is None:
        raise UsageError("--accept A B and --because TEXT: give both, or neither")
    with hapticdb.open(url) as env:
        rows = accept_clash(env, [pair[0]], [pair[1]], because or None)
    return _say_accepted([(row.a, row.b) for row in rows], because, json=json)


def _say_accepted(pairs: list[tuple[int, int]], because: str, *, json: bool) -> int:
    if json:
        for a, b in pairs:
            render.say_json({"a": a, "b": b, "because": because or None})
        return 0
    what = "accepted until a part changes its shape" if because else "no longer accepted"
    render.say(f"{render.counted(len(pairs), 'pair')} {what}")
    return 0


def _row(one: "Clash", group: str | None) -> list[object]:
    place = ("",) * 6 if one.place is None else one.place
    at_most = "" if one.at_most is None else one.at_most
    return [
        one.a, text_cell(one.a_name or ""), one.b, text_cell(one.b_name or ""), one.kind,
        one.at_least, at_most, *place, one.status, text_cell(one.because or ""),
        one.rule or "", "" if one.volume is None else one.volume, group or "",
    ]  # fmt: skip


def _show_groups(groups: "list[Group]") -> None:
    """Print the gravest groups."""
    rows = [
        (one.id, one.kind, f"{len(one.pairs):,}", f"{one.n_parts:,}", one.length_text(),
         _millimetres(one.pairs[0].place), one.status(), one.title())
        for one in groups[:MOST_ROWS]
    ]  # fmt: skip
    if rows:
        headings = ("group", "are", "pairs>", "parts>", "by>", "at, mm", "status", "which")
        render.table(headings, rows)
    if len(groups) > MOST_ROWS:
        render.say(f"{len(groups):,} groups, {MOST_ROWS} of them shown; --csv writes all pairs")


def _millimetres(place: tuple[float, ...] | None) -> str:
    return "" if place is None else place_text((1e3 * x for x in place[:3]), 0.1)


def _show_pairs(told: "list[Clash]") -> None:
    """Print the gravest pairs."""
    rows = [
        (str(one.a), one.a_name or "(gone)", str(one.b), one.b_name or "(gone)", one.kind,
         one.length_text(), one.because or one.status)
        for one in told[:MOST_ROWS]
    ]  # fmt: skip
    if rows:
        render.table(("id>", "object", "id>", "and", "are", "by>", "status"), rows)
    if len(told) > MOST_ROWS:
        render.say(f"{len(told):,} pairs, {MOST_ROWS} of them shown; --csv writes all")


def _show_facts(found: "Clashes", groups: "list[Group]") -> None:
    """Print what each rule reaches, and how many groups and pairs there are of each kind."""
    from hapticdb.clashes.rules import rule_text

    reached = [
        (str(n), rule_text(one.rule), str(one)) for n, one in enumerate(found.reach(), start=1)
    ]
    if reached:
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
