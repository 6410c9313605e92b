"""Verbs for maintenance: check, backup, grant."""

from functools import partial
from typing import TYPE_CHECKING

import typer

from hapticdb.cli import render
from hapticdb.cli.emit import Output
from hapticdb.cli.options import RightName
from hapticdb.cli.root import left_at

if TYPE_CHECKING:
    from hapticdb.check import CheckReport

MEANINGS: dict[RightName, str] = {
    "viewer": "may read and touch",
    "toucher": "may read and touch, and keep what 'hapticdb info --calibrate' measures",
    "editor": "may import, move and remove objects",
    "nobody": "has no right here any more",
}


def check(url: str, *, repair: bool = False, output: Output) -> None:
    """Verify an environment.

    The structure, rows, objects, surfaces, pairs and the log of changes are compared; each defect
    is a line. The exit code is 0 if the environment is sound, 1 if it is damaged, 2 if it cannot be
    read. --repair mends rows, then prints the remaining defects.

    Example: hapticdb check car.db
    """
    from hapticdb.check import repair_environment

    report = _read(url)
    if repair and report.is_mendable:
        render.note(
            f"mending rows: of {render.counted(len(report.wrong), 'object')} made anew, of "
            f"{len(report.orphans)} that are not there removed, of "
            f"{render.counted(len(report.pairs), 'pair')} to be measured again"
        )
        with render.bar("mending", "objects") as progress:
            repair_environment(url, report, progress=progress)
        report = _read(url)
    output.emit(report, partial(_show, report))
    if not report.is_sound:
        raise typer.Exit(1)


def _read(url: str) -> "CheckReport":
    from hapticdb.check import check_environment

    with render.bar("checking", "rows") as progress:
        return check_environment(url, progress=progress)


def _show(report: "CheckReport") -> None:
    lines = list(report.findings)
    if report.n_findings > len(lines):
        lines.append(f"and {render.counted(report.n_findings - len(lines), 'finding')} more")
    for line in lines:
        render.say(line)
    held = render.counts(object=report.objects, voxel=report.voxels, row=report.rows)
    line = f"{report.url} is sound: {held}"
    if not report.is_sound:
        count = render.counted(report.n_findings, "finding")
        mend = "'--repair' mends rows, " if report.is_mendable else ""
        line = f"{report.url} is damaged: {count}; {mend}restore a copy or import the files again"
    render.say(line, int(not report.is_sound))


def backup(url: str, file: str, *, replace: bool = False, output: Output) -> None:
    """Copy an SQLite environment into a file, whole.

    Others may work with it meanwhile. The copy has the state of one moment, opens like any
    environment, and appears only when it is complete. Other ways to copy the file miss the changes
    in its log. --replace puts a copy back in place of an environment; nobody may have that one
    open. On PostgreSQL use pg_dump and pg_restore.

    Example: hapticdb backup car.db backups/monday.db
    """
    from hapticdb.store.connect import backup_environment

    with left_at(f"there is no new {file}"), render.bar("copying", "MB", of=10**6) as progress:
        report = backup_environment(url, file, replace=replace, progress=progress)
    output.emit(
        report,
        f"{report.target}: {report.source} at revision {report.revision}, "
        f"{render.counted(report.objects, 'object')}, {report.bytes / 1e6:,.1f} MB",
    )


def grant(url: str, role: str, *, as_: RightName, output: Output) -> None:
    """Give a role rights, on PostgreSQL.

    The server enforces them. A viewer reads and touches; a toucher also stores cost figures; an
    editor also imports, moves and removes objects; nobody has no right. The grid and the rights
    belong to the owner, who made the environment.

    Example: hapticdb grant postgresql://me@host/plant anna --as editor
    """
    from hapticdb.store.connect import grant as grant_right
    from hapticdb.store.urls import redact

    grant_right(url, role, as_)
    result = {"environment": redact(url), "role": role, "right": as_}
    output.emit(result, f"{redact(url)}: {role} {MEANINGS[as_]}")
