"""The verb bench."""

from pathlib import Path
from typing import Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.options import JsonOption, UrlArgument
from hapticdb.errors import UsageError


def bench(
    url: UrlArgument,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder for results, made if missing; NAME-bench unless given."
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer frames: a first look.")] = False,
    tool: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="A tool of your own, measured beside a sphere."),
    ] = None,
    poses: Annotated[
        str | None, typer.Option(metavar="CSV", help="Path of that tool, as for 'hapticdb touch'.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Measure the paper's experiments on an environment: JSON, plots and one page of tables.

    With --json, every experiment's results are printed, too, as in its file.

    Example: hapticdb bench car.db --quick
    """
    from hapticdb.bench.run import bench as run
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.poses import read_poses
    from hapticdb.store.connect import name_of

    if (tool is None) != (poses is None):
        raise UsageError("--tool and --poses go together: give both, or neither")
    folder = out or Path(f"{Path(name_of(url)).stem}-bench")
    shell = PointShell.from_file(tool) if tool else None
    path = read_poses(poses) if poses else None
    render.compile_kernels("everything")
    page, results = run(url, folder, quick=quick, shell=shell, poses=path, say=render.note)
    if not json:
        render.say(str(page))
        return
    for found in results.values():
        render.say_json(found)
