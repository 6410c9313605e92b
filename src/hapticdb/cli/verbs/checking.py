"""The verb check."""

from typing import TYPE_CHECKING

import typer

from hapticdb.cli import render
from hapticdb.cli.options import JsonOption, UrlArgument

if TYPE_CHECKING:
    from hapticdb.check import CheckReport


def check(url: UrlArgument, *, json: JsonOption = False) -> None:
    """Read all of an environment and say what is wrong with it, a line each.

    The structure, rows, objects and the log of changes are compared. The exit code
    is 0 when it is sound, 1 when it is damaged, 2 when it cannot be read.

    Example: hapticdb check car.db
    """
    from hapticdb.check import check_environment

    render.compile_kernels("copy")
    with render.check_bar("checking") as progress:
        report = check_environment(url, progress=progress)
    if json:
        render.say_json(_record(report))
    else:
        for finding in report.findings:
            render.say(finding)
        if report.n_findings > len(report.findings):
            more = report.n_findings - len(report.findings)
            render.say(f"and {render.counted(more, 'finding')} more")
        render.say(_summary(report))
    if not report.is_sound:
        raise typer.Exit(1)


def _record(report: "CheckReport") -> dict[str, object]:
    return {"sound": report.is_sound} | vars(report)


def _summary(report: "CheckReport") -> str:
    if not report.is_sound:
        count = render.counted(report.n_findings, "finding")
        return f"{report.url} is damaged: {count}; restore a copy or import the files again"
    line = (
        f"{report.url} is sound: {render.counted(report.objects, 'object')}, "
        f"{render.counted(report.voxels, 'voxel')}, {render.counted(report.rows, 'row')}"
    )
    if report.without_row_checksums:
        line += (
            f"; {render.counted(report.without_row_checksums, 'object')} without checksums: "
            "'hapticdb copy' makes an environment that has them"
        )
    return line
