"""The verb sweep."""

import math
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple

import typer

import hapticdb
from hapticdb.cli import render
from hapticdb.cli.emit import TableOutput, open_csv
from hapticdb.cli.options import UnitName
from hapticdb.cli.selection import FilterOptions, FilterWords, ids_of
from hapticdb.cli.sweep_lists import ListedSweep, naming, read_sweeps
from hapticdb.cli.tool_options import tool_of, warn_of_size
from hapticdb.cli.values import Point, pose_of, refuse
from hapticdb.errors import UsageError
from hapticdb.tabular.schema import plain
from hapticdb.tabular.tables import open_table
from hapticdb.units import length_text
from hapticdb.verdicts import SWEEP_VERDICTS, WORST, exit_codes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.environment import Environment
    from hapticdb.exact.swept import Swept
    from hapticdb.machines.machine import Machine
    from hapticdb.mesh import Part
    from hapticdb.pointshell.shell import PointShell

HELP = f"""Check whether a tool or part is free along a path.

Clear by a gap: no surface meets the tool's. Slides: it moves along what it touches where the path
starts, and hits nothing. Overlaps: it hits nothing, but the part overlaps others by more than
--contact and --overlap where it stands. Hits: the tool meets a surface, penetrates one that it
touches, or one lies inside the other. Not decided: out of time (--seconds), or chord errors (STEP,
IFC) leave it open. The triangles decide, between the poses, too; the gap is right to 0.01 mm or 1
%.

Between two poses the centre moves straight while the tool turns about it. Segment 0 leads from pose
0 to pose 1. Turns take the short way: for half a turn or more give a pose between, or a machine of
one joint, whose angles go on beyond 360 degrees.

With --part, objects of the environment are the tool, one rigid body; the poses are displacements
from their place: x,y,z 0 and qw 1 leaves them there. 'hapticdb objects --help' says how names
choose objects.

The path is free of what is touched at the start if the tool, moved aside or deformed once by
--contact, follows it and meets nothing; once they are farther apart than that, to meet it again is
a hit. A foreign tool has no seat: if that does not free it at the first pose, it starts inside.

With --machine and --joints, the links of a URDF or MJCF file move on their joints, linearly between
two rows, and are tested against objects and one another.

--batch reads a CSV file with the columns part or tool, and path; and if wanted where, exclude and
contact (mm, or such as 0.2in). Several words in a cell stand with ; between.

--envelope stores a closed surface around all that moves on the path as an object, for clashes.

{exit_codes(SWEEP_VERDICTS, "A batch has")}

Example: hapticdb sweep car.db --part 17 --path out.csv
"""


@dataclass(frozen=True)
class SweepOptions:
    """Options common to all sweeps of a command."""

    about: Point | None = None
    overlap: float = 0.0
    tool_unit: UnitName | None = None
    path_unit: UnitName | None = None
    seconds: float | None = None
    until_hit: bool = False
    cloud_radius: float = 0.0
    gaps: list[str] | None = None
    within: float = 0.05


@dataclass(frozen=True)
class MachineOptions:
    """Options of a machine: its file and those beside it, and where it stands."""

    machine: str | None = None
    joints: str | None = None
    srdf: str | None = None
    at: str | None = None


@dataclass(frozen=True)
class EnvelopeOptions:
    """Options of the stored envelope."""

    envelope: str | None = None
    envelope_voxel: float | None = None
    replace: bool = False

    def former(self, env: "Environment") -> list[str]:
        """Id of the envelope to replace; UsageError for any other object of its name."""
        found = [obj for obj in env.objects() if obj.name == self.envelope]
        for obj in found:
            # a stored part is its own file
            is_envelope = "envelope" in obj.attributes and obj.link == obj.name
            if not (is_envelope and self.replace):
                hint = "give another, or --replace if it is an envelope"
                raise UsageError(f"--envelope {obj.name}: object {obj.id} has this name: {hint}")
        return [str(obj.id) for obj in found]


class _Job(NamedTuple):
    """Sweep with resolved objects and its poses; parts : ids of the moving objects."""

    request: ListedSweep
    poses: "NDArray[np.float64]"
    parts: list[int]
    selection: FilterWords


class _Findings(NamedTuple):
    """Result of a sweep with its tool, None for a machine; seconds : with making the tool."""

    job: _Job
    shell: "PointShell | None"
    found: "Swept"
    seconds: float
    envelope: "Part | None" = None


def sweep(
    url: str,
    *,
    tool: str | None = None,
    part: list[str] | None = None,
    path: str | None = None,
    batch: str | None = None,
    machine: MachineOptions,
    selection: FilterOptions,
    contact: float = 5e-5,
    motion: SweepOptions,
    stored: EnvelopeOptions,
    output: TableOutput,
) -> None:
    """See `HELP`."""
    from hapticdb.exact.swept import SWEPT_KEYS
    from hapticdb.tabular.gap_plot import gap_plot

    if not motion.gaps:
        refuse("without --gaps", motion, "within")
    where, exclude = selection.where or [], selection.exclude or []
    one = ListedSweep(tool, part or [], path or "", where, exclude, contact, "")
    if machine != MachineOptions():
        one = _checked_machine(one, machine, motion, batch)
    else:
        _check(one, motion, batch, output.csv)
    if batch is not None or not stored.envelope:
        refuse("with --batch, or without a name for --envelope", stored)
    requests = [one] if batch is None else read_sweeps(batch, one)
    with hapticdb.open(url, read_only=not stored.envelope) as env:
        with open_csv(output.csv, SWEPT_KEYS) as table, ExitStack() as curves:
            files = map(Path, motion.gaps or ())
            adds = [curves.enter_context(open_table(one, "--gaps", plot=gap_plot)) for one in files]
            exclude += stored.former(env)
            if machine.machine is None:
                jobs = [_job(env, each, motion.path_unit) for each in requests]
                findings = _all_told((_swept(env, job, motion, stored) for job in jobs), output)
            else:
                findings = _all_told([_machine_swept(env, one, machine, motion, stored)], output)
            if table:
                table.add(*findings[0].found.records())
            if gaps := findings[0].found.gaps:
                for add in adds:
                    add(gaps.columns())
                if gaps.is_stopped:
                    render.note("--gaps: the time was over, pairs are missing: give more --seconds")
        if batch is None and output.has_words:
            _show(findings[0])
        elif output.has_words:
            _show_batch(findings)
        if made := findings[0].envelope:  # after the files: what fails here leaves them
            env.add(made, replace=stored.replace)
            render.note(f"envelope stored as {made.name}, in voxels of {made.attributes['voxel']}")
    codes = {one.found.verdict.exit_status for one in findings}
    raise typer.Exit(next(code for code in WORST if code in codes))


sweep.__doc__ = HELP


def _check(one: ListedSweep, motion: SweepOptions, batch: str | None, csv: str | None) -> None:
    """UsageError for contradictory options."""
    if batch is not None:
        refuse("with --batch", motion, "gaps")
        _refuse_both("--batch", one, {"--csv": csv})
        return
    if (one.tool is None) == (not one.part):
        raise UsageError("give one of --tool and --part")
    if not one.path:
        raise UsageError("give --path, a file of poses, or --batch")
    if one.part and motion.tool_unit is not None:
        raise UsageError("--tool-unit has no meaning with --part: leave it out")


def _checked_machine(
    one: ListedSweep, machine: MachineOptions, motion: SweepOptions, batch: str | None
) -> ListedSweep:
    """Request for a sweep of a machine; UsageError for contradictory options."""
    if machine.machine is None or machine.joints is None:
        raise UsageError("give --machine, a URDF or MJCF file, and --joints, its path")
    _refuse_both("--machine", one, {"--batch": batch})
    refuse("with --machine", motion, "about tool_unit path_unit")
    return one._replace(tool=machine.machine, path=machine.joints)


def _refuse_both(option: str, one: ListedSweep, more: dict[str, str | None]) -> None:
    given = {"--tool": one.tool, "--part": one.part, "--path": one.path} | more
    for name, value in given.items():
        if value:
            raise UsageError(f"{option} and {name}: give only one of them")


def _job(env: "Environment", request: ListedSweep, path_unit: str | None) -> _Job:
    from hapticdb.poses import read_poses

    with naming(request.line):
        poses = read_poses(request.path, unit=path_unit or "m")
        parts = ids_of(env, request.part, "--part")
        return _Job(
            request, poses, parts, FilterOptions(request.where, request.exclude).resolve(env, parts)
        )


def _envelope(
    env: "Environment", job: _Job, moved: "PointShell | Machine", stored: EnvelopeOptions,
    about: Point | None = None, at: "NDArray[np.float64] | None" = None,
) -> "Part | None":  # fmt: skip
    """Envelope of a path, if wanted; made first: what is wrong with it ends no long sweep."""
    from hapticdb.ingest.files import ImportOptions
    from hapticdb.ingest.planning import check_names, planned
    from hapticdb.mesh import MeshFile

    if not stored.envelope:
        return None
    with render.bar("making the envelope", "samples"):
        part = hapticdb.sweep_envelope(
            moved, job.poses, stored.envelope, voxel=stored.envelope_voxel, about=about, at=at
        )
    file, most = MeshFile("--envelope", [part], part.defects), ImportOptions().voxel_limit
    check_names(file)
    planned(file, None, env.grid, {}, set(), replace=False, keep_removed=False, voxel_limit=most)
    part.attributes.update(envelope=job.request.name, path=job.request.path)
    return part


def _all_told(sweeps: Iterable[_Findings], output: TableOutput) -> list[_Findings]:
    """Run sweeps; JSON of each is printed at once."""
    from hapticdb.exact.sweep_report import verdict_line

    findings = []
    for one in sweeps:
        findings.append(one)
        if output.json:
            request, line = one.job.request, verdict_line(one.found, one.shell)
            about = {"moved": request.name, "path": request.path, "line": line}
            left = {"parts": one.job.parts, "excluded": one.job.selection.excluded}
            render.say_json(about | plain(one.found) | left)
    return findings


def _machine_swept(
    env: "Environment", request: ListedSweep, given: MachineOptions, motion: SweepOptions,
    stored: EnvelopeOptions,
) -> _Findings:  # fmt: skip
    """Read a machine, and sweep it along its joint path."""
    from hapticdb.machines.joint_path import read_joints
    from hapticdb.machines.machine_sweep import sweep_machine
    from hapticdb.machines.reader import read_machine

    began = perf_counter()
    selection = FilterOptions(request.where, request.exclude).resolve(env)
    with render.bar("reading the machine", "files"):
        machine = read_machine(given.machine or "", given.srdf)
    at = None if given.at is None else pose_of(given.at, "--at")
    job = _Job(request, read_joints(request.path, machine), [], selection)
    envelope = _envelope(env, job, machine, stored, at=at)
    with render.bar("sweeping", "objects") as progress:
        found = sweep_machine(
            env, machine, job.poses, at=at, where=selection.where, exclude=selection.exclude,
            contact=request.contact, overlap=motion.overlap, seconds=motion.seconds,
            until_hit=motion.until_hit, cloud_radius=motion.cloud_radius,
            within=motion.within if motion.gaps else None, progress=progress,
        )  # fmt: skip
    for note in found.notes:
        render.note(note)
    return _Findings(job, None, found, perf_counter() - began, envelope)


def _swept(
    env: "Environment", job: _Job, motion: SweepOptions, stored: EnvelopeOptions
) -> _Findings:
    """Make the tool, and sweep it along the path."""
    from hapticdb.exact.sweep import sweep as sweep_path

    request, selection = job.request, job.selection
    began = perf_counter()
    with naming(request.line):
        if request.tool is None:
            with render.bar("sampling the parts", "points"):
                shell = env.shell(*job.parts, points=1, inset=0.0)
        else:
            is_saved = request.tool.lower().endswith(".npz")
            points = None if is_saved else 1
            tool = tool_of(request.tool, motion.tool_unit, points, None, has_surface=True)
            warn_of_size(env, tool, selection.excluded)
            shell = tool.shell
        envelope = _envelope(env, job, shell, stored, about=motion.about)
        with render.bar("sweeping", "objects") as progress:
            found = sweep_path(
                env, shell, job.poses, where=selection.where, exclude=selection.exclude,
                contact=request.contact, overlap=motion.overlap, seated=request.tool is None,
                about=motion.about, seconds=motion.seconds, until_hit=motion.until_hit,
                cloud_radius=motion.cloud_radius, within=motion.within if motion.gaps else None,
                progress=progress,
            )  # fmt: skip
    if env.store.revision() != found.revision:
        render.note(f"{env.url} was written meanwhile; this is of revision {found.revision}")
    return _Findings(job, shell, found, perf_counter() - began, envelope)


def _show_batch(findings: Sequence[_Findings]) -> None:
    """Print a row for each sweep."""
    from hapticdb.exact.sweep_report import gap_text, percent

    rows = []
    for job, _, found, *_ in findings:
        place = found.hits[0] if found.hits else found.gap.place
        name, at = ("", "") if place is None else (place.object.name, percent(place.fraction))
        gap = gap_text(found) if found.is_free else "-"
        rows.append((job.request.name, job.request.path, found.verdict, gap, name, at))
    render.table(("part or tool", "path", "verdict", "gap>", "nearest or hit", "at>"), rows)


def _show(findings: _Findings) -> None:
    """Print the verdict, a table of hits and contacts, and the figures behind the verdict."""
    from hapticdb.exact.sweep_report import gap_text, name_of, percent, until_text, verdict_line

    found = findings.found
    render.say(verdict_line(found, findings.shell), found.verdict.exit_status)
    rows = [
        (place.object.id, name_of(place), "hit", f"at {percent(place.fraction)}", "", "")
        for place in found.hits
    ]
    rows += [
        (one.object.id, name_of(one), "touched",
         until_text(one.until).removesuffix(" of the path"),
         length_text(one.start_at_least) if one.start_at_least else "",
         length_text(one.start) if math.isfinite(one.start) else "")
        for one in found.touching
    ]  # fmt: skip
    columns = ("id>", "object", "is", "where", "overlap at start at least>", "at most>")
    render.table(columns, rows, len(rows))
    poses = render.counted(len(found.path.parameters), "pose" if findings.shell else "row")
    facts = [("path", f"{poses}, {length_text(found.path.length)}")]
    if found.is_free:
        at_most = f" proved, {length_text(found.gap.at_most)} measured at the nearest place"
        facts.append(("gap", gap_text(found) + at_most * (found.gap.place is not None)))
    near, checks = (
        render.counted(found.objects, "object"),
        render.counted(found.queries, "proximity check"),
    )
    searched = f"{near} near the path, {checks}"
    facts += [("looked at", searched), ("took", f"{findings.seconds:.2f} s")]
    if gaps := found.gaps:
        pairs = render.counted(gaps.pairs, "pair")
        facts.append(("curve", f"{pairs} within {length_text(gaps.within)}"))
    render.facts(facts)
