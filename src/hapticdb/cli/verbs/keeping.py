"""The verbs that keep an environment: check, backup, restore, upgrade, grant."""

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hapticdb.cli import render
from hapticdb.cli.options import JsonOption, UrlArgument
from hapticdb.cli.root import left_at
from hapticdb.cli.verbs.importing import JobsOption

if TYPE_CHECKING:
    from collections.abc import Callable

    from hapticdb.check import CheckReport
    from hapticdb.ingest.upgrading import UpgradeReport
    from hapticdb.store.engines import BackupReport

CopyArgument = Annotated[str, typer.Argument(metavar="FILE", help="The copy: an SQLite file.")]
RightName = Literal["viewer", "toucher", "editor", "nobody"]
MEANINGS: dict[RightName, str] = {
    "viewer": "may read and touch",
    "toucher": "may read and touch, and keep what 'hapticdb info --calibrate' measures",
    "editor": "may import, move and remove objects",
    "nobody": "has no right here any more",
}


def check(
    url: UrlArgument,
    *,
    repair: Annotated[
        bool,
        typer.Option(
            "--repair", help="Then make wrong rows anew, from surfaces; remove stray ones."
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Read all of an environment and say what is wrong with it, a line each.

    The structure, rows, objects and the log of changes are compared. The exit code
    is 0 when it is sound, 1 when it is damaged, 2 when it cannot be read. With
    --repair it says what is still wrong when rows are mended.

    Example: hapticdb check car.db
    """
    from hapticdb.check import check_environment, repair_environment

    render.compile_kernels("copy", *(["move"] if repair else []))
    report = _read(url, check_environment)
    if repair and (report.wrong or report.strays):
        render.note(
            f"mending rows: of {render.counted(len(report.wrong), 'object')} made anew, of "
            f"{len(report.strays)} that are not there removed"
        )
        with render.bar("mending", "objects") as progress:
            repair_environment(url, report, progress=progress)
        report = _read(url, check_environment)
    if json:
        render.say_json({"sound": report.is_sound} | vars(report))
    else:
        for finding in report.findings:
            render.say(finding)
        if report.n_findings > len(report.findings):
            more = report.n_findings - len(report.findings)
            render.say(f"and {render.counted(more, 'finding')} more")
        render.say(_checked(report))
    if not report.is_sound:
        raise typer.Exit(1)


def _read(url: str, check_environment: "Callable[..., CheckReport]") -> "CheckReport":
    with render.bar("checking", "rows") as progress:
        return check_environment(url, progress=progress)


def _checked(report: "CheckReport") -> str:
    if not report.is_sound:
        count = render.counted(report.n_findings, "finding")
        mend = "'--repair' mends rows, " if report.wrong or report.strays else ""
        return f"{report.url} is damaged: {count}; {mend}restore a copy or import the files again"
    line = (
        f"{report.url} is sound: {render.counted(report.objects, 'object')}, "
        f"{render.counted(report.voxels, 'voxel')}, {render.counted(report.rows, 'row')}"
    )
    if report.without_row_checksums:
        line += (
            f"; {render.counted(report.without_row_checksums, 'object')} without checksums: "
            "'hapticdb copy' makes an environment that has them"
        )
    if report.without_surfaces:
        line += (
            f"; {render.counted(report.without_surfaces, 'object')} without surfaces: "
            "'hapticdb upgrade' reads them"
        )
    return line


def backup(
    url: UrlArgument,
    file: CopyArgument,
    *,
    replace: Annotated[bool, typer.Option("--replace", help="Replace a copy that exists.")] = False,
    json: JsonOption = False,
) -> None:
    """Copy an environment whole into a file, while others go on working with it.

    The copy holds the environment as of one moment, can be opened as any
    other, and appears when it is whole. Copying the file by other means
    leaves out what is still in its log. On PostgreSQL pg_dump does this.

    Example: hapticdb backup car.db backups/monday.db
    """
    from hapticdb.store.connect import backup_environment

    with left_at(f"there is no new {file}"), render.bar("copying", "MB", of=10**6) as progress:
        report = backup_environment(url, file, replace=replace, progress=progress)
    _say_copied(report, json=json)


def restore(file: CopyArgument, url: UrlArgument, *, json: JsonOption = False) -> None:
    """Put a copy in an environment's place, and remove the log of what was there.

    The environment stays as it is until the copy is whole beside it, and is
    replaced then; nobody may have it open. FILE stays as it is. On PostgreSQL
    pg_restore does this.

    Example: hapticdb restore backups/monday.db car.db
    """
    from hapticdb.store.connect import restore_environment

    with left_at(f"{url} is as it was"), render.bar("copying", "MB", of=10**6) as progress:
        report = restore_environment(file, url, progress=progress)
    _say_copied(report, json=json)


def _say_copied(report: "BackupReport", *, json: bool) -> None:
    if json:
        render.say_json(report._asdict())
        return
    render.say(
        f"{report.target}: {report.source} at revision {report.revision}, "
        f"{render.counted(report.objects, 'object')}, {report.bytes / 1e6:,.1f} MB"
    )


def upgrade(url: UrlArgument, *, jobs: JobsOption = None, json: JsonOption = False) -> None:
    """Give objects what an earlier version has not stored: surfaces, and distances to them.

    A surface that is missing is read from the object's file; moves, tools and
    views need it. Smooth forces need distances; the layout voxel has none.
    Voxels stay as they are. Every object is written in a transaction of its
    own: run the same command again to go on with what was interrupted. An
    object whose file is gone or has changed is named and stays as it is, and
    the exit code is 1. Parts that are imported later get distances, too.

    Example: hapticdb upgrade car.db
    """
    from hapticdb.ingest.upgrading import upgrade_environment

    with left_at("what is upgraded is whole, and the same command goes on from there"):
        render.compile_kernels("move")
        with render.import_bar() as progress:
            report = upgrade_environment(url, jobs=jobs, progress=progress)
    for left in report.left_out:
        render.note(str(left.error))
    if json:
        render.say_json(_upgrade_record(report))
    else:
        render.say(_upgraded(report))
    if not report.is_complete:
        raise typer.Exit(1)


def _upgrade_record(report: "UpgradeReport") -> dict[str, object]:
    return {
        "url": report.url,
        "surfaces": report.surfaces,
        "upgraded": report.upgraded,
        "present": report.present,
        "voxels": report.voxels,
        "left_out": [
            {"id": obj.id, "name": obj.name, "link": obj.link, "error": str(left.error)}
            for left in report.left_out
            for obj in left.objects
        ],
    }


def _upgraded(report: "UpgradeReport") -> str:
    there = render.counted(report.present, "object")
    if not (report.surfaces or report.upgraded) and report.is_complete:
        return f"{report.url}: complete already ({there}), nothing to do"
    line = f"{report.url}: distances for {render.counted(report.upgraded, 'object')}"
    if report.surfaces:
        line += f", surfaces for {report.surfaces:,}"
    if report.present:
        line += f"; {there} had all already"
    if not report.is_complete:
        n_left = sum(len(left.objects) for left in report.left_out)
        line += f"; {render.counted(n_left, 'object')} left out; the same command tries again"
    return line


def grant(
    url: UrlArgument,
    role: Annotated[str, typer.Argument(metavar="ROLE", help="A role of the server.")],
    *,
    right: Annotated[
        RightName,
        typer.Option("--as", help="What ROLE may do from now on, instead of what it may do now."),
    ],
    json: JsonOption = False,
) -> None:
    """Say what a role may do with an environment on PostgreSQL; the server holds it to that.

    A viewer reads and touches; a toucher also keeps cost figures; an editor
    also imports, moves and removes objects; nobody has no right. The grid
    and the rights belong to the owner, who made the environment.

    Example: hapticdb grant postgresql://me@host/plant anna --as editor
    """
    from hapticdb.store.connect import grant as grant_right
    from hapticdb.store.urls import redact

    grant_right(url, role, right)
    if json:
        render.say_json({"environment": redact(url), "role": role, "right": right})
    else:
        render.say(f"{redact(url)}: {role} {MEANINGS[right]}")
