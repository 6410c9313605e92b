"""The verb sweep."""

import math
from collections.abc import Sequence
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from hapticdb.cli import render
from hapticdb.cli.choosing import felt_objects, ids_of
from hapticdb.cli.csv_files import STDOUT, SWEPT, open_csv, rows_of_sweep
from hapticdb.cli.options import (
    CsvOption,
    ExcludeOption,
    JsonOption,
    OptionalToolOption,
    PathUnitOption,
    ToolUnitOption,
    UrlArgument,
    WhereOption,
    length_option,
)
from hapticdb.cli.sweep_lists import Asked, naming, read_sweeps
from hapticdb.cli.tools import tool_of, warn_of_size
from hapticdb.cli.values import Point, point_of
from hapticdb.errors import UsageError
from hapticdb.units import length_text
from hapticdb.verdicts import SWEEP_VERDICTS, WORST, exit_codes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.cli.choosing import Felt
    from hapticdb.environment import Environment
    from hapticdb.exact.swept import Swept
    from hapticdb.pointshell.shell import PointShell

MOST_OBJECTS = 20
"""Rows of the table of what is hit or touched; the other objects are counted below it."""

PartsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--part",
        metavar="WORDS",
        help="Instead of --tool: objects that move, all together; chosen as for --exclude.",
    ),
]
PathOption = Annotated[
    str | None, typer.Option(metavar="CSV", help="Poses x,y,z,qw,qx,qy,qz with a header.")
]
ContactOption = Annotated[
    float,
    length_option(
        "what is so near where the path starts may be touched; a motion by so much has to free "
        "the tool from it all along.",
        "0.05",
    ),
]
OverlapOption = Annotated[
    float, length_option("by so much a part may overlap others where it stands.", "0")
]
UntilHitOption = Annotated[
    bool, typer.Option("--until-hit", help="End at the first hit on the path: faster.")
]
AboutOption = Annotated[
    Point | None,
    length_option(
        "the centre of the path's turns, tool's frame.", "middle of the tool's box", parse=point_of
    ),
]
SweepSecondsOption = Annotated[
    float | None,
    typer.Option(metavar="S", help="Time of a sweep.", show_default="no limit"),
]
BatchOption = Annotated[
    str | None,
    typer.Option(metavar="CSV", help="Many sweeps, one a line; see above."),
]

HELP = f"""Say whether a tool or part is free on a path: what it hits, where, how near it comes.

Clear by a gap: no surface meets the tool's. Slides: it moves along what it
touches where the path starts, and hits nothing. Overlaps: it hits nothing, but
the part overlaps others by more than --contact and --overlap where it stands.
Hits: a surface is met, what is touched is gone into, or one lies inside the
other. Not decided: --seconds were over, or chord errors (STEP, IFC) leave
it open. The triangles decide, between the poses, too; the gap is right to 0.01 mm
or 1 %.

Between two poses the centre moves straight while the tool turns about it.
Segment 0 leads from pose 0 to pose 1.

With --part, objects of the environment are the tool, one rigid body; the poses
are displacements from their place: x,y,z 0 and qw 1 leaves them there. 'hapticdb
objects --help' says how names choose objects.

The path is free of what is touched at the start if the tool, moved aside or
deformed once by --contact, follows it and meets nothing; once they are farther
apart than that, to meet it again is a hit. A foreign tool has no seat: if that
does not free it at the first pose, it starts inside.

--batch reads a CSV file with the columns part or tool, and path; and if wanted
where, exclude and contact (mm, or such as 0.2in). Several words in a cell stand
with ; between.

{exit_codes(SWEEP_VERDICTS)}
A batch has the worst: 1 before 3 before 4 before 0.

Example: hapticdb sweep car.db --part 17 --path out.csv
"""


class _Options(NamedTuple):
    """Options that all sweeps of a command share; about, overlap : metres."""

    tool_unit: str | None
    about: Point | None
    overlap: float
    seconds: float | None
    until_hit: bool


class _Job(NamedTuple):
    """A sweep whose words and path are read; parts : ids of what moves."""

    asked: Asked
    poses: "NDArray[np.float64]"
    parts: list[int]
    felt: "Felt"


class _Told(NamedTuple):
    """A sweep's result with its tool, the exit code, and the seconds that it took with the tool."""

    job: _Job
    shell: "PointShell"
    found: "Swept"
    code: int
    seconds: float


def sweep(
    url: UrlArgument,
    *,
    tool: OptionalToolOption = None,
    part: PartsOption = None,
    path: PathOption = None,
    where: WhereOption = None,
    exclude: ExcludeOption = None,
    contact: ContactOption = 5e-5,
    overlap: OverlapOption = 0.0,
    about: AboutOption = None,
    tool_unit: ToolUnitOption = None,
    path_unit: PathUnitOption = None,
    batch: BatchOption = None,
    seconds: SweepSecondsOption = None,
    until_hit: UntilHitOption = False,
    csv: CsvOption = None,
    json: JsonOption = False,
) -> None:
    """Sweep a tool or parts along a path; the help text is `HELP`."""
    import hapticdb

    one = Asked(tool, part or [], path or "", where or [], exclude or [], contact, "")
    _check(one, tool_unit, batch, csv)
    if csv == STDOUT and json:
        raise UsageError("--csv - and --json: only one may be standard output")
    options = _Options(tool_unit, about, overlap, seconds, until_hit)
    asked = [one] if batch is None else read_sweeps(batch, one)
    with open_csv(csv, "--csv", SWEPT) as table, hapticdb.open(url, read_only=True) as env:
        jobs = [_job(env, each, path_unit) for each in asked]
        if batch is not None:
            raise typer.Exit(_run_batch(env, jobs, options, json=json))
        told = _swept(env, jobs[0], options)
        if table:
            table.write(rows_of_sweep(told.found))
        if json:
            _say_json(told)
        elif csv != STDOUT:
            _show(told)
    raise typer.Exit(told.code)


def _check(one: Asked, tool_unit: str | None, batch: str | None, csv: str | None) -> None:
    """Refuse options that contradict one another."""
    if batch is not None:
        given = {"--tool": one.tool, "--part": one.part, "--path": one.path, "--csv": csv}
        for name, value in given.items():
            if value:
                raise UsageError(f"--batch and {name}: give only one of them")
        return
    if (one.tool is None) == (not one.part):
        raise UsageError("give one of --tool and --part")
    if not one.path:
        raise UsageError("give --path, a file of poses, or --batch")
    if one.part and tool_unit is not None:
        raise UsageError(
            "--tool-unit belongs to --tool: a part has the unit that it was imported in"
        )


def _job(env: "Environment", asked: Asked, path_unit: str | None) -> _Job:
    from hapticdb.poses import read_poses

    with naming(asked.line):
        poses = read_poses(asked.path, unit=path_unit or "m")
        parts = ids_of(env, asked.part, "--part")
        return _Job(asked, poses, parts, felt_objects(env, asked.where, asked.exclude, parts))


def _swept(env: "Environment", job: _Job, options: _Options) -> _Told:
    """Make the tool, and move it along the path."""
    from hapticdb.exact.sweep import sweep as sweep_path

    asked, felt = job.asked, job.felt
    began = perf_counter()
    with naming(asked.line):
        if asked.tool is None:
            with render.bar("sampling the parts", "points"):
                shell = env.shell(*job.parts, points=1, inset=0.0)
        else:
            is_saved = asked.tool.lower().endswith(".npz")
            points = None if is_saved else 1
            tool = tool_of(asked.tool, options.tool_unit, points, None, has_surface=True)
            warn_of_size(env, tool, felt.left_out)
            shell = tool.shell
        with render.bar("sweeping", "objects") as progress:
            found = sweep_path(
                env, shell, job.poses, where=felt.where, exclude=felt.exclude,
                contact=asked.contact, overlap=options.overlap, seated=asked.tool is None,
                about=options.about, seconds=options.seconds,
                until_hit=options.until_hit, progress=progress,
            )  # fmt: skip
    if env.store.revision() != found.revision:
        render.note(f"{env.url} was written meanwhile; this is of revision {found.revision}")
    return _Told(job, shell, found, found.verdict.exit_status, perf_counter() - began)


def _run_batch(env: "Environment", jobs: Sequence[_Job], options: _Options, *, json: bool) -> int:
    """Run all sweeps, print a line or a row for each; returns the worst exit code."""
    from hapticdb.exact.report import gap_text, percent

    rows, codes = [], set()
    for job in jobs:
        told = _swept(env, job, options)
        codes.add(told.code)
        if json:
            _say_json(told)
            continue
        found = told.found
        place = found.hits[0] if found.hits else found.gap.place
        name, at = ("", "") if place is None else (place.object.name, percent(place.fraction))
        gap = gap_text(found) if found.is_free else "-"
        rows.append((job.asked.name, job.asked.path, found.verdict, gap, name, at))
    if rows:
        render.table(("part or tool", "path", "verdict", "gap>", "nearest or hit", "at>"), rows)
    return next(code for code in WORST if code in codes)


def _say_json(told: _Told) -> None:
    from hapticdb.exact.report import sweep_record

    job = told.job
    record = sweep_record(told.found, told.shell, job.parts, job.felt.left_out)
    render.say_json({"moved": job.asked.name, "path": job.asked.path} | record)


def _show(told: _Told) -> None:
    """Print the verdict, a table of what is hit or touched, and the figures that it stands on."""
    from hapticdb.exact.report import gap_text, percent, until_text, verdict_line

    found = told.found
    render.say(verdict_line(found, told.shell))
    rows = [
        (str(place.object.id), place.object.name, "hit", f"at {percent(place.fraction)}", "", "")
        for place in found.hits
    ]
    rows += [
        (
            str(one.object.id),
            one.object.name,
            "touched",
            until_text(one.until).removesuffix(" of the path"),
            length_text(one.start_at_least) if one.start_at_least else "",
            length_text(one.start) if math.isfinite(one.start) else "",
        )
        for one in found.touching
    ]
    if rows:
        columns = ("id>", "object", "is", "where", "overlap at start at least>", "at most>")
        render.table(columns, rows[:MOST_OBJECTS])
        if len(rows) > MOST_OBJECTS:
            render.say(f"{len(rows)} rows, {MOST_OBJECTS} of them shown")
    poses = render.counted(len(found.path.poses), "pose")
    facts = [("path", f"{poses}, {length_text(found.path.length)}")]
    if found.is_free:
        facts.append(("gap", _gap_range(found, gap_text(found))))
    near, looks = render.counted(found.objects, "object"), render.counted(found.looks, "look")
    looked = f"{near} near the path, {looks}"
    facts += [("looked at", looked), ("took", f"{told.seconds:.2f} s")]
    render.facts(facts)


def _gap_range(found: "Swept", text: str) -> str:
    """The gap's bounds."""
    if found.gap.place is None:
        return text
    return f"{text} proved, {length_text(found.gap.at_most)} measured at the nearest place"
