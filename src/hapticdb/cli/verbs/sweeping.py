"""The verb sweep."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hapticdb.cli import fitting, render
from hapticdb.cli.choosing import felt_objects, ids_of
from hapticdb.cli.csv_files import STDOUT, SWEPT, open_csv, rows_of_sweep
from hapticdb.cli.options import (
    BudgetOption,
    CsvOption,
    ExcludeOption,
    JsonOption,
    OptionalToolOption,
    PathUnitOption,
    PosesOption,
    SeedOption,
    ToolUnitOption,
    UrlArgument,
    WhereOption,
)
from hapticdb.cli.tools import shell_of
from hapticdb.cli.values import budget_bytes
from hapticdb.errors import UsageError
from hapticdb.units import length_text

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.sweeps.result import Clearance, Swept

EXIT_CODES = {"comes out": 0, "hits": 1, "not decided": 3}
DOUBTFUL = 3
"""Exit code of "comes out", too, where tool, path and scene do not fit."""
DENSE = 0.5
"""Voxels from point to point of the tool, unless --points are given."""

MOST_OBJECTS = 20
"""Rows of the table of what is hit; the other objects are counted below it."""

UpName = Literal["x", "y", "z"]
PartsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--part",
        metavar="WORDS",
        help="Instead of --tool: objects that move, all together; chosen as for --exclude.",
    ),
]
ClearanceOption = Annotated[
    float | None,
    typer.Option(
        metavar="M",
        help="Distance up to which clearance is looked for; 0: not at all.",
        show_default="32 voxels",
    ),
]
DensePointsOption = Annotated[
    int | None,
    typer.Option(metavar="N", help="Points of the shell.", show_default="half a voxel apart"),
]
AsGivenOption = Annotated[
    bool,
    typer.Option(
        "--as-given", help="The sizes and places are right: exit code 0 when it comes out."
    ),
]
LeaveStartOption = Annotated[
    bool,
    typer.Option(
        "--leave-start",
        help="Leave out the objects that are hit at the first pose, if it is proved that the tool "
        "goes no deeper into them.",
    ),
]
ToleranceOption = Annotated[
    float | None,
    typer.Option(
        metavar="MM",
        help="Say hits only where surfaces are proved to come so near; other hits are grazes.",
        show_default="a voxel's diagonal",
    ),
]
RefineOption = Annotated[
    bool,
    typer.Option("--refine", help="Where it is not decided, look at finer points by itself."),
]
PictureOption = Annotated[
    str | None, typer.Option(metavar="PNG", help="Draw the path, its hits and clearance.")
]
UpOption = Annotated[
    UpName | None,
    typer.Option(help="Axis that points up in the picture.", show_default="the files'"),
]

HELP = """Say whether a tool or part comes out along a path: what it hits, where, how near it comes.

Hits: a point of the tool is in a voxel of an object, or something lies inside
a closed body of the tool. Comes out: proved for the whole surface and the whole
path. Not decided: neither; a line says what would decide it.

Between two poses the tool's middle moves straight while the tool turns about
it, in steps in which no point moves more than half a voxel. Segment 0 leads
from pose 0 to pose 1.

With --part, objects of the environment are the tool: all of them together are
one rigid body, which is not felt. The poses are displacements from where the
objects are: x,y,z 0 and qw 1 is their present place. A sub-assembly's name means
all that is below it; 'hapticdb objects --help' says how names choose objects.

Where distances are stored, they decide what voxels leave open. A proved verdict
says how far the surfaces keep apart (docs/paths.md).

The points are half a voxel apart, 200,000 at most, unless --points are given.

The exit code is 0 when it comes out, 1 when it hits, 3 when it is not decided.
It is 3, too, when it comes out but the sizes or places of tool, path and scene do
not fit together; a line then says so. With --as-given they are taken as right.

Example: hapticdb sweep car.db --part 17 --path out.csv --picture out.png
"""
"""The verb's help text: longer than a function of this house may be."""


def sweep(
    url: UrlArgument,
    *,
    tool: OptionalToolOption = None,
    part: PartsOption = None,
    path: PosesOption,
    where: WhereOption = None,
    exclude: ExcludeOption = None,
    clearance: ClearanceOption = None,
    budget: BudgetOption = 256.0,
    tool_unit: ToolUnitOption = None,
    path_unit: PathUnitOption = None,
    points: DensePointsOption = None,
    seed: SeedOption = None,
    as_given: AsGivenOption = False,
    leave_start: LeaveStartOption = False,
    tolerance: ToleranceOption = None,
    refine: RefineOption = False,
    csv: CsvOption = None,
    picture: PictureOption = None,
    up: UpOption = None,
    json: JsonOption = False,
) -> None:
    """Sweep a tool or parts along a path; the help text is `HELP`."""
    import hapticdb
    from hapticdb.poses import read_poses
    from hapticdb.sweeps.record import sweep_record
    from hapticdb.sweeps.run import sweep as sweep_path

    _check(tool, part, tool_unit, picture, csv if json else None)
    poses = read_poses(path, unit=path_unit or "m")
    with open_csv(csv, "--csv", SWEPT) as table, hapticdb.open(url, read_only=True) as env:
        parts = ids_of(env, part, "--part")
        felt = felt_objects(env, where, exclude, parts)
        render.compile_kernels("sweep", files=[tool] if tool else [])
        shell = _shell(env, tool, parts, tool_unit, points, seed)
        fit = fitting.compare(
            env, shell, poses, exclude=felt.left_out, tool=tool, tool_unit=tool_unit,
            path_unit=path_unit, is_moving=True,
        )  # fmt: skip
        with render.bar("sweeping", "samples", lambda *now: now) as progress:
            found = sweep_path(
                env, shell, poses, where=felt.where, exclude=felt.exclude, proportions=fit,
                budget_bytes=budget_bytes(budget), clearance_limit=clearance, refine=refine,
                profile=picture is not None, progress=progress, leave_start=leave_start,
                tolerance=None if tolerance is None else 1e-3 * tolerance,
            )  # fmt: skip
        _note_writes(env, found)
        if table:
            table.write(rows_of_sweep(found))
        try:
            if json:
                render.say_json(sweep_record(found, shell, parts, felt.left_out))
            elif csv != STDOUT:
                _show(env, found, shell)
        finally:  # also when who reads, such as head, has enough
            if picture is not None:
                _draw(picture, env, shell, found, felt.left_out, up)
    _exit(found, None if json or csv == STDOUT else picture, bool(fit.misfits) and not as_given)


def _exit(found: "Swept", picture: str | None, is_doubtful: bool) -> None:  # noqa: FBT001
    """Name the picture, if any, and end with the verdict's exit code."""
    if picture is not None:
        render.say(f"picture: {picture}")
    if found.verdict != "comes out":
        raise typer.Exit(EXIT_CODES[found.verdict])
    if is_doubtful:
        raise typer.Exit(DOUBTFUL)


def _note_writes(env: "Environment", found: "Swept") -> None:
    """Say that others have written since the sweep began, if they have."""
    if env.store.revision() != found.revision:
        render.note(f"{env.url} was written meanwhile; this is of revision {found.revision}")


def _check(
    tool: str | None,
    part: list[str] | None,
    tool_unit: str | None,
    picture: str | None,
    csv_beside_json: str | None,
) -> None:
    """Refuse options that contradict one another."""
    if csv_beside_json == STDOUT:
        raise UsageError("--csv - and --json: only one may be standard output")
    if (tool is None) == (not part):
        raise UsageError("give one of --tool and --part")
    if part and tool_unit is not None:
        raise UsageError(
            "--tool-unit belongs to --tool: a part has the unit that it was imported in"
        )
    check_picture(picture)


def check_picture(picture: str | None) -> None:
    """Refuse a name that is no PNG's."""
    if picture is not None and Path(picture).suffix.lower() != ".png":
        raise UsageError(f"--picture {picture!r}: give a name that ends with .png")


def _shell(
    env: "Environment",
    tool: str | None,
    parts: list[int],
    tool_unit: str | None,
    points: int | None,
    seed: int | None,
) -> "PointShell":
    """Shell of the tool's file, or of the parts, with its covering radius."""
    spacing = DENSE * env.grid.voxel_size if points is None else None
    if tool is not None:
        return shell_of(tool, tool_unit, points, seed, spacing).with_cover()
    return env.shell(*parts, points=points, spacing=spacing, seed=seed or 0).with_cover()


def _draw(
    picture: str,
    env: "Environment",
    shell: "PointShell",
    found: "Swept",
    excluded: list[int],
    up: UpName | None,
) -> None:
    from hapticdb.pictures.demo import save
    from hapticdb.pictures.sweep import compose_sweep
    from hapticdb.sweeps.verdict import verdict_line

    verdict = verdict_line(found, shell)
    figure = compose_sweep(env, shell, found, exclude=excluded, verdict=verdict, up=up)
    save(figure, picture)


def _show(env: "Environment", found: "Swept", shell: "PointShell") -> None:
    """Print the verdict, a table of what is hit, and the figures that it stands on."""
    from hapticdb.sweeps.verdict import percent, verdict_line

    render.say(verdict_line(found, shell))
    if found.objects:
        rows = [
            (
                str(one.object.id),
                one.object.name,
                f"{percent(one.first)} to {percent(one.last)}",
                length_text(one.length),
                f"{one.samples:,}",
                f"{one.contacts:,}",
                f"{one.points:,}",
            )
            for one in found.objects[:MOST_OBJECTS]
        ]
        columns = ("id>", "hit", "of the path>", "length>", "samples>", "in contact>", "points>")
        render.table(columns, rows)
        if len(found.objects) > MOST_OBJECTS:
            render.say(f"{len(found.objects)} objects, {MOST_OBJECTS} of them shown")
    render.facts(_facts(env, found, shell))


def _facts(env: "Environment", found: "Swept", shell: "PointShell") -> list[tuple[str, str]]:
    from hapticdb.sweeps.record import median_spacing
    from hapticdb.sweeps.verdict import depth_text

    size = env.grid.voxel_size
    way = f"{len(found.path.poses):,} poses given, {found.samples:,} samples"
    tool = f"{len(shell):,} points, {length_text(median_spacing(shell))} apart (median)"
    if found.proof.cover is not None:
        tool += f", none of its surface more than {length_text(found.proof.cover)} from one"
    rows = [
        ("path", f"{way}, no point moves more than {length_text(0.5 * size)} between two"),
        ("tool", tool),
        ("hits", f"{found.hits:,} samples hit, {found.contacts:,} in contact"),
    ]
    if found.clearance is not None and not found.hits:
        rows.append(("clearance", _clearance_text(found.clearance)))
    rows += [(f"in {one.object.name}", depth_text(one)) for one in found.depths[:MOST_OBJECTS]]
    rate = f"{found.samples / max(found.elapsed, 1e-9):,.0f} poses a second"
    rows.append(("took", f"{found.elapsed:.2f} s, {rate}, {found.cells:,} cells fetched"))
    return rows


def _clearance_text(clearance: "Clearance") -> str:
    """What the number means: a surface lies somewhere in its voxel, and beside the points."""
    from hapticdb.sweeps.verdict import names_of, percent

    if clearance.moment is None:
        return f"no voxel nearer than {length_text(clearance.distance)}; farther is not looked"
    return (
        f"{length_text(clearance.distance)} from a voxel of {names_of(clearance.moment.objects)} "
        f"at {percent(clearance.moment.fraction)}: the surfaces are "
        f"{length_text(clearance.at_least)} to {length_text(clearance.at_most)} apart"
    )
