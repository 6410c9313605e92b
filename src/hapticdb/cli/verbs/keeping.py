"""The verbs that keep environments as whole copies: backup and restore."""

from typing import TYPE_CHECKING, Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.options import JsonOption, UrlArgument
from hapticdb.cli.root import Interrupted

if TYPE_CHECKING:
    from hapticdb.store.engines import BackupReport

CopyArgument = Annotated[str, typer.Argument(metavar="FILE", help="The copy: an SQLite file.")]


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

    try:
        with render.file_bar("copying") as progress:
            report = backup_environment(url, file, replace=replace, progress=progress)
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; there is no new {file}") from None
    _say(report, json=json)


def restore(file: CopyArgument, url: UrlArgument, *, json: JsonOption = False) -> None:
    """Put a copy in an environment's place, and remove the log of what was there.

    The environment stays as it is until the copy is whole beside it, and is
    replaced then; nobody may have it open. FILE stays as it is. On PostgreSQL
    pg_restore does this.

    Example: hapticdb restore backups/monday.db car.db
    """
    from hapticdb.store.connect import restore_environment

    try:
        with render.file_bar("copying") as progress:
            report = restore_environment(file, url, progress=progress)
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; {url} is as it was") from None
    _say(report, json=json)


def _say(report: "BackupReport", *, json: bool) -> None:
    if json:
        render.say_json(report._asdict())
        return
    render.say(
        f"{report.target}: {report.source} at revision {report.revision}, "
        f"{render.counted(report.objects, 'object')}, {report.bytes / 1e6:,.1f} MB"
    )
