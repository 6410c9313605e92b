"""The verb extract."""

from typing import TYPE_CHECKING, Annotated, TypedDict

import typer

from hapticdb.cli import render
from hapticdb.cli.choosing import felt_objects, ids_of
from hapticdb.cli.options import (
    BudgetOption,
    ExcludeOption,
    JsonOption,
    ObjectsArgument,
    UrlArgument,
    WhereOption,
)
from hapticdb.cli.values import budget_bytes
from hapticdb.cli.verbs.paths.disassembling import EXIT_CODES as ORDER_EXIT_CODES
from hapticdb.cli.verbs.paths.disassembling import Outputs, report, write
from hapticdb.cli.verbs.paths.sweeping import PictureOption, UpOption, check_picture
from hapticdb.errors import UsageError

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.extraction.pulls import SearchCallback
    from hapticdb.extraction.result import Extraction

EXIT_CODES = {
    "comes out": 0, "slides out": 0, "comes out of contact": 3, "not decided": 3, "no way found": 1,
}  # fmt: skip
MOST_BLOCKERS = 10
"""Rows of the table of what is in the way."""

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
    typer.Option(
        metavar="M",
        help="Distance at which the part counts as out.",
        show_default="clear of all that stands",
    ),
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

HELP = """Search a path on which parts come out, and prove it by a sweep.

The parts that WORDS choose move together as one rigid body. Straight pulls are
tried first: along the axes, away from contacts and along them, at random. If none
leads out, a planner (OMPL, pip install 'hapticdb[extract]') searches a path round
corners and with turns. A part is out when its bounding sphere is clear of the box
of all that stands, or at --out.

The path is written by --path as displacements from the present place, as
'hapticdb sweep --part' takes them. The same seed gives the same path, unless
--seconds end the search.

Comes out: a sweep proves it for the whole surface and the whole path. Comes out,
no deeper than so much in what it touches at its start: proved, too, on the whole
path. Comes out, once it has left what it touches: proved from a stated place on
only; how deep it gets before is not known. Not decided: a path, but no proof. No way found:
what blocks most of the straight pulls is named; this is no proof that there is none.

With --disassemble, what blocks the parts is taken off first, each object alone
and on a path that is proved; --keep names what stays. Each step has a file of its
own: --path out.csv writes out-1.csv and so on. The order may be longer than
necessary.

--animation writes a page for any browser, with all that it needs in one file (pip
install 'hapticdb[view]').

The exit code is 0 when all of the path is proved, 3 when a path is found and not
all of it is proved, 1 when no path is found.

Example: hapticdb extract car.db body/hood --path out.csv --picture out.png
"""
"""The verb's help text: longer than a function of this house may be."""


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
    where: WhereOption = None,
    exclude: ExcludeOption = None,
    budget: BudgetOption = 256.0,
    path: WayOption = None,
    picture: PictureOption = None,
    animation: AnimationOption = None,
    up: UpOption = None,
    json: JsonOption = False,
) -> None:
    """Search a path on which parts come out; the help text is `HELP`."""
    import hapticdb
    from hapticdb.extraction import run
    from hapticdb.extraction.disassembly import run as orders

    check_picture(picture)
    _check_animation(animation)
    if not disassemble and (depth is not None or keep):
        raise UsageError("--depth and --keep go with --disassemble")
    asked = Outputs(path, picture, animation, up, json)
    n_bytes = budget_bytes(budget)
    with hapticdb.open(url, read_only=True) as env:
        ids = ids_of(env, parts, "PART")
        felt = felt_objects(env, where, exclude, ids)
        kept = ids_of(env, keep, "--keep") if keep else []
        render.compile_kernels("extract")
        with render.pull_bar() as progress:
            options: _Options = {
                "where": felt.where, "seed": seed, "motions": motions, "out": out,
                "budget_bytes": n_bytes, "progress": progress,
            }  # fmt: skip
            if disassemble:
                order = orders.disassemble(
                    env, *ids, exclude=exclude or (), keep=kept,
                    depth=orders.DEFAULT_DEPTH if depth is None else depth,
                    seconds=orders.DEFAULT_ORDER_SECONDS if seconds is None else seconds, **options,
                )  # fmt: skip
            else:
                seconds = run.DEFAULT_SECONDS if seconds is None else seconds
                found = run.extract(env, *ids, exclude=felt.exclude, seconds=seconds, **options)
        if disassemble:
            report(env, order, asked)
            code = ORDER_EXIT_CODES[order.verdict]
        else:
            _report(env, found, felt.left_out, asked)
            code = EXIT_CODES[found.verdict]
    if code:
        raise typer.Exit(code)


class _Options(TypedDict):
    """Options of both searches."""

    where: "list[str]"
    seed: int
    motions: int
    out: float | None
    budget_bytes: int
    progress: "SearchCallback | None"


def _check_animation(animation: str | None) -> None:
    """Refuse, before anything is searched, an animation that could not be written."""
    if animation is None:
        return
    if not animation.lower().endswith(".html"):
        raise UsageError(f"--animation {animation}: it is a page, give a name that ends in .html")
    from hapticdb.page.animation import check_view

    check_view()


def _report(env: "Environment", found: "Extraction", left_out: list[int], asked: Outputs) -> None:
    """Print the verdict; write path, picture and animation of a path that was found."""
    from hapticdb.extraction.record import extraction_record

    def tell() -> None:
        if asked.json:
            render.say_json(extraction_record(found, left_out))
        else:
            _show(found, asked)

    write(env, [] if found.way is None else [(found, left_out)], asked, tell)


def _show(found: "Extraction", asked: Outputs) -> None:
    """Print the verdict, what is in the way, and the figures of the search."""
    from hapticdb.extraction.verdict import extraction_line
    from hapticdb.sweeps.verdict import depth_text, names_of

    render.say(extraction_line(found))
    if found.way is None and found.blockers:
        rows = [
            (str(one.object.id), one.object.name, f"{one.pulls} of {found.pulls}")
            for one in found.blockers[:MOST_BLOCKERS]
        ]
        render.show(render.table(("id>", "in the way", "of pulls>"), rows))
    touched = names_of(found.touched) if found.touched else "nothing"
    facts = [
        ("touches at its start", touched),
        ("searched", f"{found.pulls} pulls, {found.motions:,} motions, {found.poses:,} poses"),
        ("took", f"{found.seconds:.1f} s"),
    ]
    if found.way is not None:
        facts += [(f"depth in {one.object.name}", depth_text(one)) for one in found.way.depths]
        files = (("path", asked.path), ("picture", asked.picture), ("animation", asked.animation))
        for name, file in files:
            if file is not None:
                facts.append((name, file))
    render.show(render.facts(facts))
