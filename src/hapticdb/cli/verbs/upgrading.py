"""The verb upgrade."""

from typing import TYPE_CHECKING

import typer

from hapticdb.cli import render
from hapticdb.cli.options import JsonOption, UrlArgument
from hapticdb.cli.root import Interrupted
from hapticdb.cli.verbs.importing import JobsOption

if TYPE_CHECKING:
    from hapticdb.ingest.upgrading import UpgradeReport


def upgrade(url: UrlArgument, *, jobs: JobsOption = None, json: JsonOption = False) -> None:
    """Give distances to the objects of an environment, from which smooth forces are computed.

    The file of each object is read again; its voxels stay as they are. Every
    object is written in a transaction of its own: run the same command again
    to go on with what was interrupted. An object whose file is gone or has
    changed is named and stays without, and the exit code is 1. Parts that are
    imported later get distances, too. The layout voxel has none.

    Example: hapticdb upgrade car.db
    """
    from hapticdb.ingest.upgrading import upgrade_environment

    try:
        render.compile_kernels("move")
        with render.import_bar() as progress:
            report = upgrade_environment(url, jobs=jobs, progress=progress)
    except KeyboardInterrupt:
        raise Interrupted(
            "interrupted; what is upgraded is whole, and the same command goes on from there"
        ) from None
    for left in report.left_out:
        render.note(str(left.error))
    if json:
        render.say_json(_record(report))
    else:
        render.say(_upgraded(report))
    if not report.is_complete:
        raise typer.Exit(1)


def _record(report: "UpgradeReport") -> dict[str, object]:
    return {
        "url": report.url,
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
    if not report.upgraded and report.is_complete:
        return f"{report.url}: complete already ({there}), nothing to do"
    line = f"{report.url}: distances for {render.counted(report.upgraded, 'object')}"
    if report.present:
        line += f"; {report.present} had them already"
    if not report.is_complete:
        n_left = sum(len(left.objects) for left in report.left_out)
        line += f"; {render.counted(n_left, 'object')} without; the same command tries again"
    return line
