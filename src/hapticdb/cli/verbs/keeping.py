"""The verbs that keep environments: whole copies (backup, restore), even servers (rebalance)."""

from typing import TYPE_CHECKING, Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.options import JsonOption, UrlArgument
from hapticdb.cli.root import Interrupted

if TYPE_CHECKING:
    from hapticdb.store.engines import BackupReport
    from hapticdb.store.sharding import Rebalanced

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


def rebalance(url: UrlArgument, *, json: JsonOption = False) -> None:
    """Give each of an environment's servers equally many rows, while others go on with it.

    For environments whose rows are on several PostgreSQL servers
    (shards=server1,server2). Rows move a few megabytes at a time; whoever
    touches them meanwhile feels no difference. Run the same command again
    to go on with what was interrupted. Only the owner may do it.

    Example: hapticdb rebalance postgresql://me@host/plant
    """
    from hapticdb.store.connect import rebalance_environment

    try:
        with render.rebalance_bar() as progress:
            report = rebalance_environment(url, progress=progress)
    except KeyboardInterrupt:
        raise Interrupted(
            "interrupted; what has moved is whole, and the same command goes on from there"
        ) from None
    if json:
        render.say_json(report._asdict())
    else:
        render.say(_rebalanced(report))


def _rebalanced(report: "Rebalanced") -> str:
    def listed(rows: tuple[int, ...]) -> str:
        return " + ".join(f"{n:,}" for n in rows)

    if not report.moved_rows:
        return f"{report.environment}: balanced already ({listed(report.rows_after)} rows)"
    return (
        f"{report.environment}: {render.counted(report.moved_rows, 'row')} moved "
        f"({report.moved_bytes / 1e6:,.1f} MB); rows of the servers before: "
        f"{listed(report.rows_before)}, now: {listed(report.rows_after)}"
    )


def _say(report: "BackupReport", *, json: bool) -> None:
    if json:
        render.say_json(report._asdict())
        return
    render.say(
        f"{report.target}: {report.source} at revision {report.revision}, "
        f"{render.counted(report.objects, 'object')}, {report.bytes / 1e6:,.1f} MB"
    )
