"""The verb extract."""

from typing import TYPE_CHECKING, Annotated

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
from hapticdb.cli.verbs.paths.sweeping import PictureOption, UpName, UpOption, check_picture

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.extraction.result import Extraction

EXIT_CODES = {
    "comes out": 0, "slides out": 0, "comes out of contact": 3, "not decided": 3, "no way found": 1,
}  # fmt: skip
MOST_BLOCKERS = 10
"""Rows of the table of what is in the way."""

SecondsOption = Annotated[float, typer.Option(metavar="S", help="Time of the search.")]
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

The exit code is 0 when all of the path is proved, 3 when a path is found and not
all of it is proved, 1 when no path is found.

Example: hapticdb extract car.db body/hood --path out.csv --picture out.png
"""
"""The verb's help text: longer than a function of this house may be."""


def extract(
    url: UrlArgument,
    parts: ObjectsArgument,
    *,
    seconds: SecondsOption = 60.0,
    seed: SeedOption = 0,
    motions: MotionsOption = 20_000,
    out: OutOption = None,
    where: WhereOption = None,
    exclude: ExcludeOption = None,
    budget: BudgetOption = 256.0,
    path: WayOption = None,
    picture: PictureOption = None,
    up: UpOption = None,
    json: JsonOption = False,
) -> None:
    """Search a path on which parts come out; the help text is `HELP`."""
    import hapticdb
    from hapticdb.extraction.record import extraction_record
    from hapticdb.extraction.run import extract as search
    from hapticdb.poses import write_poses

    check_picture(picture)
    n_bytes = budget_bytes(budget)
    with hapticdb.open(url, read_only=True) as env:
        ids = ids_of(env, parts, "PART")
        felt = felt_objects(env, where, exclude, ids)
        render.compile_kernels("extract")
        with render.pull_bar() as progress:
            found = search(
                env, *ids, where=felt.where, exclude=felt.exclude, seconds=seconds, seed=seed,
                motions=motions, out=out, budget_bytes=n_bytes, progress=progress,
            )  # fmt: skip
        if found.way is not None and path is not None:
            write_poses(path, found.way.poses)
        if json:
            render.say_json(extraction_record(found, felt.left_out))
        else:
            _show(found, path, picture)
        if found.way is not None and picture is not None:
            _draw(picture, env, found, felt.left_out, up)
    if found.verdict != "comes out":
        raise typer.Exit(EXIT_CODES[found.verdict])


def _show(found: "Extraction", path: str | None, picture: str | None) -> None:
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
        for name, file in (("path", path), ("picture", picture)):
            if file is not None:
                facts.append((name, file))
    render.show(render.facts(facts))


def _draw(
    picture: str, env: "Environment", found: "Extraction", excluded: list[int], up: UpName | None
) -> None:
    from hapticdb.extraction.verdict import extraction_line
    from hapticdb.pictures.sweep import draw_sweep

    if found.way is not None:
        draw_sweep(
            picture, env, found.shell, found.way.swept, exclude=excluded,
            verdict=extraction_line(found), up=up,
        )  # fmt: skip
