"""The verb extract."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from hapticdb.cli import render
from hapticdb.cli.choosing import felt_objects, ids_of
from hapticdb.cli.options import (
    BudgetOption,
    ClusterOption,
    ExcludeOption,
    JsonOption,
    ObjectsArgument,
    UrlArgument,
    WhereOption,
    length_option,
)
from hapticdb.cli.values import budget_bytes, numbers_of, point_of
from hapticdb.cli.verbs.sweeping import ContactOption, OverlapOption
from hapticdb.errors import UsageError
from hapticdb.verdicts import EXTRACT_VERDICTS, exit_codes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.environment import Environment
    from hapticdb.extraction.disassembly import Disassembly
    from hapticdb.extraction.result import Extraction

MOST_BLOCKERS = 10
"""Rows of the table of what is in the way, and of the table of searches that failed."""

UpName = Literal["x", "y", "z"]
SecondsOption = Annotated[
    float | None,
    typer.Option(
        metavar="S", help="Time of the search.", show_default="60; 600 with --disassemble"
    ),
]
SeedOption = Annotated[int, typer.Option(metavar="N", help="Seed of the search.")]
MotionsOption = Annotated[
    int, typer.Option(metavar="N", help="Motions that the planner tries; 0: straight pulls only.")
]
OutOption = Annotated[
    float | None,
    length_option("so far from its start the part counts as out.", "clear of all that stands"),
]
ToOption = Annotated[
    str | None,
    typer.Option(
        metavar="POSE",
        help="Reach this displacement instead: x,y,z,qw,qx,qy,qz, millimetres, or "
        "such as 0,5,0.2in,1,0,0,0; or a CSV file of one pose, metres.",
    ),
]
ScrewOption = Annotated[
    float | None, length_option("the pitch of a thread, of either hand, a turn.")
]
WayOption = Annotated[
    str | None, typer.Option("--path", metavar="CSV", help="Write the path that was found.")
]

DisassembleOption = Annotated[
    bool,
    typer.Option("--disassemble", help="Take off what blocks the parts first, step by step."),
]
DepthOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Most objects that wait for one another, beside the parts.",
        show_default="3",
    ),
]
KeepOption = Annotated[
    list[str] | None,
    typer.Option(metavar="WORDS", help="Objects that are never taken off; as for --exclude."),
]
AnimationOption = Annotated[
    str | None,
    typer.Option(metavar="HTML", help="Write a page that shows how the parts come out."),
]
UpOption = Annotated[
    UpName | None,
    typer.Option(help="Axis that points up in the animation.", show_default="the files'"),
]

HELP = f"""Search a path on which parts come out, judged by a sweep of their surfaces.

The parts that WORDS choose move together as one rigid body. Straight pulls are
tried first: along the axes, away from contacts and along them, at random; with
--screw then screw motions. If none leads out, a planner (OMPL, pip install ompl)
searches a path round corners and with turns. A part is out when its bounding
sphere is clear of the box of all that stands, or at --out. With --to, a way to a
pose is searched instead.

The path is written by --path as displacements from the present place, as
'hapticdb sweep --part' takes them. The same seed gives the same path, unless
--seconds end the search.

Overlaps count if they are more than --contact and --overlap. Where no way is found,
what blocks most of the straight pulls is named.

With --disassemble, what blocks the parts is taken off first, each object alone
and on a path that is proved; --keep names what stays. Each step has a file of its
own: --path out.csv writes out-1.csv and so on. The order may be longer than
necessary.

--animation writes a page for any browser, with all that it needs in one file (pip
install viser).

{exit_codes(EXTRACT_VERDICTS)}

Example: hapticdb extract car.db body/hood --path out.csv
"""


def extract(
    url: UrlArgument,
    parts: ObjectsArgument,
    *,
    disassemble: DisassembleOption = False,
    depth: DepthOption = None,
    keep: KeepOption = None,
    seconds: SecondsOption = None,
    seed: SeedOption = 0,
    motions: MotionsOption = 20_000,
    out: OutOption = None,
    to: ToOption = None,
    screw: ScrewOption = None,
    contact: ContactOption = 5e-5,
    overlap: OverlapOption = 0.0,
    where: WhereOption = None,
    exclude: ExcludeOption = None,
    budget: BudgetOption = 256.0,
    on: ClusterOption = None,
    path: WayOption = None,
    animation: AnimationOption = None,
    up: UpOption = None,
    json: JsonOption = False,
) -> None:
    """Search a path on which parts come out; the help text is `HELP`."""
    import hapticdb
    from hapticdb.extraction import disassembly as orders
    from hapticdb.extraction import run

    _check_animation(animation)
    if not disassemble and (depth is not None or keep or on):
        raise UsageError("--depth, --keep and --on go with --disassemble")
    if to and (disassemble or out or screw):
        raise UsageError("--to goes with none of --disassemble, --out and --screw")
    goal = _goal(to) if to else None
    asked = _Outputs(path, animation, up, json)
    options: dict[str, Any] = {
        "seed": seed, "motions": motions, "out": out, "screw": screw,
        "contact": contact, "overlap": overlap, "budget_bytes": budget_bytes(budget),
        **({} if seconds is None else {"seconds": seconds}),
    }  # fmt: skip
    with hapticdb.open(url, read_only=True) as env:
        ids = ids_of(env, parts, "PART")
        felt = felt_objects(env, where, exclude, ids)
        kept = ids_of(env, keep, "--keep") if keep else []
        with render.bar("pulling", "searches" if on else "pulls") as progress:
            options |= {"where": felt.where, "progress": progress}
            if disassemble:
                options |= {} if depth is None else {"depth": depth}
                options |= {"exclude": exclude or (), "keep": kept, "on": on}
                order = orders.disassemble(env, *ids, **options)
            else:
                found = run.extract(env, *ids, exclude=felt.exclude, to=goal, **options)
        if disassemble:
            _report_order(env, order, asked)
        else:
            _report(env, found, felt.left_out, asked)
    raise typer.Exit((order if disassemble else found).verdict.exit_status)


def _goal(to: str) -> "NDArray[np.float64]":
    """The pose (4, 4) that --to names: numbers in millimetres, or a file."""
    import numpy as np

    from hapticdb.poses import pose_of_row, read_poses

    if to.lower().endswith(".csv"):
        poses = read_poses(to)
        if len(poses) != 1:
            raise UsageError(f"--to {to}: it has {len(poses)} poses, give a file of one")
        return np.asarray(poses[0])
    words = to.replace(",", " ").split()
    try:
        place = point_of(" ".join(words[:3]), "mm")
        turn = numbers_of(" ".join(words[3:]), 4, "--to", "qw,qx,qy,qz")
    except UsageError:
        form = "x,y,z,qw,qx,qy,qz, or a file whose name ends in .csv"
        raise UsageError(f"--to {to[:80]!r}: give {form}") from None
    return pose_of_row(place, turn)


class _Outputs(NamedTuple):
    """What is written beside the printed lines: names of files, or None."""

    path: str | None
    animation: str | None
    up: UpName | None
    json: bool

    def of_step(self, step: int) -> "_Outputs":
        """Files of a step of an order: ``out.csv`` is ``out-1.csv`` for the first step, 0."""
        if self.path is None:
            return self
        path = Path(self.path)
        return self._replace(path=str(path.with_name(f"{path.stem}-{step + 1}{path.suffix}")))


class _Way(NamedTuple):
    """A way that was found, the ids of what is not felt on it, and its files."""

    found: "Extraction"
    excluded: Sequence[int]
    files: _Outputs


def _check_animation(animation: str | None) -> None:
    """Refuse, before anything is searched, an animation that could not be written."""
    if animation is None:
        return
    if not animation.lower().endswith(".html"):
        raise UsageError(f"--animation {animation}: it is a page, give a name that ends in .html")
    from hapticdb.page.animation import check_view

    check_view()


def _report(env: "Environment", found: "Extraction", left_out: list[int], asked: _Outputs) -> None:
    """Print the verdict; write path and animation of a path that was found."""
    from hapticdb.extraction.verdict import extraction_record

    ways = [] if found.way is None else [_Way(found, left_out, asked)]
    _write_paths(ways)
    if asked.json:
        render.say_json(extraction_record(found, left_out))
    else:
        _show(found, asked)
    _draw(env, ways, asked)


def _report_order(env: "Environment", found: "Disassembly", asked: _Outputs) -> None:
    """Print an order or why there is none; write a path a step, and an animation."""
    from hapticdb.extraction.verdict import disassembly_record

    steps = found.steps if found.is_found else ()
    ways = [_Way(step.found, step.excluded, asked.of_step(n)) for n, step in enumerate(steps)]
    _write_paths(ways)
    if asked.json:
        render.say_json(disassembly_record(found))
    else:
        _show_order(found, ways)
    _draw(env, ways, asked)


def _write_paths(ways: Sequence[_Way]) -> None:
    from hapticdb.poses import write_poses

    for found, _, files in ways:
        if files.path is not None and found.way is not None:
            write_poses(files.path, found.way.poses)


def _draw(env: "Environment", ways: Sequence[_Way], asked: _Outputs) -> None:
    """Draw the animation if it was asked for."""
    if asked.animation is not None and ways:
        from hapticdb.page.animation import animate

        steps = [way.found for way in ways]
        animate(asked.animation, env, steps, exclude=ways[-1].excluded, up=asked.up)


def _show(found: "Extraction", asked: _Outputs) -> None:
    """Print the verdict, what is in the way, and the figures of the search."""
    from hapticdb.exact.report import names_of
    from hapticdb.extraction.verdict import extraction_line

    render.say(extraction_line(found))
    if found.way is None and found.blockers:
        rows = [
            (str(one.object.id), one.object.name, f"{one.pulls} of {found.pulls}")
            for one in found.blockers[:MOST_BLOCKERS]
        ]
        render.table(("id>", "in the way", "of pulls>"), rows)
    pulls, motions, poses = (
        render.counted(n, noun)
        for n, noun in ((found.pulls, "pull"), (found.motions, "motion"), (found.poses, "pose"))
    )
    facts = [
        ("near its start", names_of(found.near) or "nothing"),
        ("searched", f"{pulls}, {motions}, {poses}"),
        ("took", f"{found.seconds:.1f} s"),
    ]
    if found.way is not None:
        files = asked._asdict()
        facts += [(name, files[name]) for name in ("path", "animation") if files[name]]
    render.facts(facts)


def _show_order(found: "Disassembly", ways: Sequence[_Way]) -> None:
    from hapticdb.exact.report import names_of
    from hapticdb.extraction.verdict import disassembly_line, extraction_line, failed_line

    render.say(disassembly_line(found))
    for n, step in enumerate(found.steps):
        render.say(f"{n + 1}. {names_of(step.found.parts)}: {extraction_line(step.found)}")
    if not found.is_found and found.failed:
        rows = [
            (names_of(one.parts), str(one.n_gone), failed_line(one))
            for one in found.failed[-MOST_BLOCKERS:]
        ]
        render.table(("tried", "after steps>", "result"), rows)
    facts = [("took", f"{found.seconds:.1f} s")]
    if ways:
        ends = [way.files._asdict() for way in (ways[0], ways[-1])]
        facts += [
            (name, " ... ".join(dict.fromkeys(end[name] for end in ends)))
            for name in ("path", "animation")
            if ends[0][name]
        ]
    render.facts(facts)
