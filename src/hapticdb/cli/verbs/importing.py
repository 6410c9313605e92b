"""The verb import."""

import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from math import ceil, log2
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from hapticdb.cli import render
from hapticdb.cli.emit import Output
from hapticdb.cli.options import CurveName, LayoutName, UnitName
from hapticdb.cli.root import left_at
from hapticdb.cli.values import Point
from hapticdb.errors import UsageError
from hapticdb.tabular.schema import plain
from hapticdb.units import length_text

if TYPE_CHECKING:
    from hapticdb.ingest.files import FileReport

MOST_BITS = 21


@dataclass(frozen=True)
class NewGridOptions:
    """Options of a new environment's grid and rows."""

    bits: int | None = None
    voxel_size: float | None = None
    extent: float | None = None
    origin: Point | None = None
    layout: LayoutName | None = None
    curve: CurveName | None = None
    distances: bool | None = None
    partitions: str | None = None


@dataclass(frozen=True)
class ReadingOptions:
    """Options of reading files."""

    unit: UnitName | None = None
    chord: float | None = None
    jobs: int | None = None
    on: str | None = None
    time_limit: float | None = None
    memory_limit: int | None = None
    voxel_limit: int | None = None
    replace: bool = False
    keep_removed: bool = False


def import_(
    url: str, files: list[str], *, grid: NewGridOptions, reading: ReadingOptions, output: Output
) -> None:
    """Import CAD files and point clouds.

    A missing environment is created. Every part becomes an object, in a transaction of its own:
    after an interruption, run the same command again to continue. An unusable file is named and
    skipped, and the others are imported. Parts that were removed are imported again, and counted,
    unless --keep-removed omits them.

    Files are added to an existing environment. With --replace it follows the files: objects of
    another geometry, place or unit are replaced under their ids, moved ones go back, and those
    missing from the file are removed; each in a transaction, so an interruption loses none.

    Example: hapticdb import car.db car.glb --bits 11 --extent 1.6

    Example: hapticdb import 'postgresql://me@host/plant?environment=hall' plant.glb
    """
    from hapticdb.grid import GridOptions
    from hapticdb.ingest.files import ImportOptions, import_files
    from hapticdb.mesh.parse import READERS, is_tessellated
    from hapticdb.store.urls import with_partitions

    if Path(url).suffix.lower() in READERS:
        env = next((one for one in files if Path(one).suffix.lower() not in READERS), "car.db")
        raise UsageError(f"{url} is a file to import; the environment is first: {env} {url}")
    if grid.partitions is not None:
        url = with_partitions(url, grid.partitions)
    options = ImportOptions(
        grid=GridOptions(grid.bits, grid.voxel_size, grid.extent, grid.origin, grid.curve),
        layout=grid.layout, distances=grid.distances, skip_unusable=True, **vars(reading),
    )  # fmt: skip
    if options.chord is not None and not any(map(is_tessellated, files)):
        render.note("--chord changes nothing: it is for STEP and IFC files")
    started = time.perf_counter()
    with (
        left_at("what went in is whole, and the same command goes on from there"),
        render.import_bar() as progress,
    ):
        reports = import_files(url, files, options, progress)
    _print_reports(url, files, reports, time.perf_counter() - started, output)
    if any(report.error for report in reports):
        raise typer.Exit(2)


def _print_reports(
    url: str, files: Sequence[str], reports: "Sequence[FileReport]", elapsed: float, output: Output
) -> None:
    """Print the result of each file, and the environment's contents."""
    from hapticdb.store.attributes import scene_bounds
    from hapticdb.store.connect import open_store

    line, scene, voxel_size, bits = "", None, 0.0, 0
    if not all(report.error for report in reports):
        with closing(open_store(url, read_only=True)) as store:
            size, objects = store.size(), store.objects()
            scene, held = scene_bounds(objects), render.counts(object=len(objects), row=size.rows)
            voxel_size, bits = store.grid.voxel_size, store.grid.bits
            held += f", {render.bytes_text(size.bytes)}"
            line = f"{store.url}: {held}; {store.grid.describe()}"
    for file, report in zip(files, reports, strict=True):
        if output.json:
            n_voxels = sum(obj.voxels for obj in report.added)
            more = {"objects": len(report.added), "voxels": n_voxels}
            render.say_json(plain(report) | more | {"scene": render.box_record(scene)})
        elif report.error is None:
            for line_of_file in _lines(file, report):
                render.say(line_of_file)
        if report.error is not None:
            render.note(str(report.error))
    if not output.json and any(report.status == "imported" for report in reports):
        render.say(f"{line}; {elapsed:.1f} s")
        if scene is not None:
            render.say(f"the scene: {render.box(scene)}")
            _warn_of_voxels(voxel_size, bits)


def _warn_of_voxels(size: float, bits: int) -> None:
    """Note voxels above 1 m, with the bits for half a metre, and below 10 nm."""
    if size > 1.0 and bits < MOST_BITS:
        more = min(bits + ceil(log2(size / 0.5)), MOST_BITS)
        finer = length_text(size / 2 ** (more - bits))
        render.note(f"voxels of {length_text(size)} are coarse: --bits {more} makes them {finer}")
    elif size < 1e-8:
        render.note(f"voxels of {1e9 * size:.3g} nm: is --unit right?")


def _lines(file: str, report: "FileReport") -> Iterator[str]:
    """Result of a file, and remarks on it, indented."""
    if report.status == "complete":
        there = render.counted(report.present, "object")
        line = f"{file}: complete already ({there}), nothing to do"
    else:
        added = render.counted(len(report.added), "object")
        voxels = render.counted(sum(obj.voxels for obj in report.added), "voxel")
        line = f"{file}: {added} imported, {voxels}"
        for count, words in (
            (report.present, "were there already"),
            (report.replaced, "replaced"),
            (report.dropped, "removed, which the file has no more"),
            (report.restored, "of them had been removed and are back: --keep-removed omits them"),
        ):
            line += f"; {count} {words}" if count else ""
    if report.still_removed:
        line += f"; {render.counted(report.still_removed, 'removed part')} left out"
    yield line
    if report.is_unit_assumed:
        yield "  its unit is not known: its numbers are taken as metres; --unit gives another"
    if report.chord:
        yield f"  chord error of its triangles: {length_text(report.chord)}"
    if report.defects:
        yield f"  found in the file: {report.defects.describe()}"
    yield from (f"  note: {note}" for note in report.notes)
