"""The verb import."""

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from hapticdb.cli import render
from hapticdb.cli.options import (
    ClusterOption,
    CurveOption,
    JsonOption,
    LayoutOption,
    UnitName,
    UrlArgument,
    length_option,
)
from hapticdb.cli.root import left_at
from hapticdb.cli.values import Point, point_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.ingest.files import FileReport, ImportOptions

FilesArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="FILE...",
        help="GLB, glTF, OBJ, STL, PLY, 3MF, OFF, DAE; STEP, IFC, LAS and LAZ with their extras.",
    ),
]
UnitOption = Annotated[
    UnitName | None, typer.Option(help="Unit of files that name no unit; metres unless given.")
]
BitsOption = Annotated[
    int | None,
    typer.Option(metavar="1..21", help="Bits of each axis: 2^bits voxels.", show_default="10"),
]
VoxelSizeOption = Annotated[float | None, length_option("edge of a voxel.", unit="m")]
ExtentOption = Annotated[
    float | None,
    typer.Option(
        metavar="FACTOR",
        help="Edge of the grid: so many times the longest side of the bounding box of all files.",
        show_default="1.6",
    ),
]
OriginOption = Annotated[
    Point | None,
    length_option(
        "lower corner of the grid.",
        "so that the files are in its middle",
        parse=point_of,
        unit="m",
    ),
]
JobsOption = Annotated[
    int | None, typer.Option(metavar="N", help="Threads.", show_default="one a processor")
]
KeepRemovedOption = Annotated[
    bool, typer.Option("--keep-removed", help="Leave out parts that were removed.")
]
TimeLimitOption = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="Time that reading one file may take.",
        show_default="20 and more by its size",
    ),
]
MemoryLimitOption = Annotated[
    int | None,
    typer.Option(
        metavar="MIB",
        help="Memory that reading one file may take.",
        show_default="512 and more by its size",
    ),
]
VoxelLimitOption = Annotated[
    float,
    typer.Option(metavar="N", help="Voxels that the surfaces of one file may meet, by their area."),
]
ReplaceOption = Annotated[
    bool,
    typer.Option("--replace", help="Replace objects of these files by what the files hold now."),
]
DistancesOption = Annotated[
    bool | None,
    typer.Option(
        "--distances/--no-distances",
        help="Store distances to surfaces, which coupled sessions need, in a new environment.",
        show_default="yes for bricks",
    ),
]
ChordOption = Annotated[
    float | None,
    length_option(
        "chord error of STEP and IFC files, how far triangles may lie from the surfaces.",
        "0.01, IFC 0.1",
    ),
]
PartitionsOption = Annotated[
    str | None,
    typer.Option(
        metavar="SERVERS",
        help="A new environment on PostgreSQL: hosts or URLs, with commas between, of the servers "
        "that get its rows.",
    ),
]


def import_(
    url: UrlArgument,
    files: FilesArgument,
    *,
    unit: UnitOption = None,
    bits: BitsOption = None,
    voxel_size: VoxelSizeOption = None,
    extent: ExtentOption = None,
    origin: OriginOption = None,
    layout: LayoutOption = None,
    curve: CurveOption = None,
    jobs: JobsOption = None,
    on: ClusterOption = None,
    keep_removed: KeepRemovedOption = False,
    time_limit: TimeLimitOption = None,
    memory_limit: MemoryLimitOption = None,
    voxel_limit: VoxelLimitOption = 1e9,
    replace: ReplaceOption = False,
    distances: DistancesOption = None,
    chord: ChordOption = None,
    partitions: PartitionsOption = None,
    json: JsonOption = False,
) -> None:
    """Import files into an environment, which is made when it does not exist.

    Every part becomes an object, in a transaction of its own: run the same
    command again to go on with what was interrupted. A file that cannot be
    used is named and skipped, and the others go in. Parts that were removed
    come in again, and are counted, unless --keep-removed leaves them out.

    To an environment that exists, files are added. With --replace it holds
    what they hold now: objects of another geometry, place or unit are replaced
    under their ids, moved ones go back, and those that the file lacks are
    removed; each in a transaction, so that an interruption loses none.

    Example: hapticdb import car.db car.glb --bits 11 --extent 1.6

    Example: hapticdb import 'postgresql://me@host/plant?environment=hall' plant.glb
    """
    from hapticdb.grid import GridOptions
    from hapticdb.ingest.files import ImportOptions
    from hapticdb.store.urls import with_partitions

    if partitions is not None:
        url = with_partitions(url, partitions)
    grid = GridOptions(bits=bits, voxel_size=voxel_size, extent=extent, origin=origin, curve=curve)
    options = ImportOptions(
        unit=unit, grid=grid, layout=layout, jobs=jobs, on=on, keep_removed=keep_removed,
        time_limit=time_limit, memory_limit=None if memory_limit is None else memory_limit << 20,
        replace=replace, distances=distances, skip_unusable=True, chord=chord,
        voxel_limit=voxel_limit,
    )  # fmt: skip
    reports, elapsed = _imported(url, files, options)
    _tell(url, files, reports, elapsed, json=json)
    if any(report.error for report in reports):
        raise typer.Exit(2)


def _tell(
    url: str, files: Sequence[str], reports: "Sequence[FileReport]", elapsed: float, *, json: bool
) -> None:
    """Print what became of each file, and what the environment holds now."""
    held = None if all(report.error for report in reports) else _Held.by(url)
    for file, report in zip(files, reports, strict=True):
        if json:
            scene = render.box_record(None if held is None else held.scene)
            render.say_json(_record(report) | {"scene": scene})
        elif report.error is None:
            _say(file, report)
        if report.error is not None:
            render.note(str(report.error))
    if not json and held is not None and any(report.status == "imported" for report in reports):
        render.say(f"{held.line}; {elapsed:.1f} s")
        if held.scene is not None:
            render.say(f"the scene: {render.box(held.scene)}")


def _imported(
    url: str, files: Sequence[str], options: "ImportOptions"
) -> "tuple[list[FileReport], float]":
    """Import files: a report of each, and seconds."""
    from hapticdb.ingest.files import import_files
    from hapticdb.mesh.parse import is_tessellated

    if options.chord is not None and not any(map(is_tessellated, files)):
        render.note(
            "--chord changes nothing: it is for STEP and IFC, and the triangles of others are kept"
        )
    with left_at("what went in is whole, and the same command goes on from there"):
        started = time.perf_counter()
        with render.import_bar() as progress:
            reports = import_files(url, files, options, progress)
    return reports, time.perf_counter() - started


class _Held(NamedTuple):
    """What an environment holds now, in a line, and the bounds of all of it."""

    line: str
    scene: "NDArray[np.float64] | None"

    @classmethod
    def by(cls, url: str) -> "_Held":
        from contextlib import closing

        from hapticdb.store.attributes import scene_bounds
        from hapticdb.store.connect import open_store

        with closing(open_store(url, read_only=True)) as store:
            size, objects = store.size(), store.objects()
            line = (
                f"{store.url}: {render.counted(len(objects), 'object')}, "
                f"{render.counted(size.rows, 'row')}, {render.bytes_text(size.bytes)}; "
                f"{store.grid.describe()}"
            )
            return cls(line, scene_bounds(objects))


def _record(report: "FileReport") -> dict[str, object]:
    return {
        "file": report.link,
        "status": report.status,
        "objects": len(report.added),
        "present": report.present,
        "restored": report.restored,
        "kept_removed": report.kept_removed,
        "replaced": report.replaced,
        "dropped": report.dropped,
        "voxels": sum(obj.voxels for obj in report.added),
        "chord_error": report.chord or None,
        "is_unit_assumed": report.is_unit_assumed,
        "defects": report.defects.as_dict(),
        "notes": list(report.notes),
        "error": None if report.error is None else str(report.error),
    }


def _say(file: str, report: "FileReport") -> None:
    from hapticdb.units import length_text

    if report.status == "complete":
        there = render.counted(report.present, "object")
        line = f"{file}: complete already ({there}), nothing to do"
    else:
        voxels = sum(obj.voxels for obj in report.added)
        line = (
            f"{file}: {render.counted(len(report.added), 'object')} imported, "
            f"{render.counted(voxels, 'voxel')}"
        )
        if report.present:
            line += f"; {report.present} were there already"
        if report.replaced:
            line += f"; {report.replaced} replaced"
        if report.dropped:
            line += f"; {report.dropped} removed, which the file has no more"
        if report.restored:
            line += (
                f"; {report.restored} of them had been removed and are back: --keep-removed leaves "
                "such parts out"
            )
    if report.kept_removed:
        line += f"; {render.counted(report.kept_removed, 'removed part')} left out"
    render.say(line)
    if report.is_unit_assumed:
        render.say("  its unit is not known: its numbers are taken as metres; --unit gives another")
    if report.chord:
        render.say(f"  chord error of its triangles: {length_text(report.chord)}")
    if report.defects:
        render.say(f"  found in the file: {report.defects.describe()}")
    for note in report.notes:
        render.say(f"  note: {note}")
