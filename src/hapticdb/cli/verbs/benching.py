"""The verb bench."""

from pathlib import Path
from typing import Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.options import JsonOption
from hapticdb.errors import UsageError

FEEL_FOLDER = "feel-bench"
"""Folder for results of --feel without an environment of one's own."""


def bench(
    url: Annotated[
        str | None,
        typer.Argument(
            metavar="URL", help="The environment, as for 'hapticdb info'; --feel needs none."
        ),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder for results, made if missing; NAME-bench unless given."
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer frames: a first look.")] = False,
    feel: Annotated[
        bool,
        typer.Option(
            "--feel", help="How good the forces feel, under both laws; walks over URL if given."
        ),
    ] = False,
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

    With --feel it measures how good the forces feel instead: ripple, steps, force against depth,
    stability with a simulated person, both laws side by side. It prints their table, and which
    measures miss what is wanted. With --json, every experiment's results are printed, too, as in
    its file.

    Example: hapticdb bench car.db --quick
    """
    from hapticdb.store.connect import name_of

    if (tool is None) != (poses is None):
        raise UsageError("--tool and --poses go together: give both, or neither")
    folder = out or Path(f"{Path(name_of(url)).stem}-bench" if url else FEEL_FOLDER)
    if feel:
        if tool is not None:
            raise UsageError("--feel has tools of its own: leave out --tool and --poses")
        _bench_feel(url, folder, quick=quick, json=json)
    elif url is None:
        raise UsageError("no environment: name one, or give --feel, which needs none")
    else:
        _bench_paper(url, folder, quick=quick, tool=tool, poses=poses, json=json)


def _bench_feel(url: str | None, folder: Path, *, quick: bool, json: bool) -> None:
    """Measure both laws; print their table and what is missed, or the result as JSON."""
    import hapticdb
    from hapticdb.bench.feel.page import missed_lines, table_of
    from hapticdb.bench.feel.run import feel

    if url is not None:
        hapticdb.open(url, read_only=True).close()
    render.compile_kernels("everything")
    page, result = feel(folder, url=url, quick=quick, say=render.note)
    if json:
        render.say_json(result)
        return
    render.say(table_of(result["cells"]))
    for line in missed_lines(result["cells"]):
        render.say(line)
    render.say(str(page))


def _bench_paper(
    url: str, folder: Path, *, quick: bool, tool: str | None, poses: str | None, json: bool
) -> None:
    """Run the paper's experiments; print the page's name, or the results as JSON."""
    from hapticdb.bench.run import bench as run
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.poses import read_poses

    shell = PointShell.from_file(tool) if tool else None
    path = read_poses(poses) if poses else None
    render.compile_kernels("everything")
    page, results = run(url, folder, quick=quick, shell=shell, poses=path, say=render.note)
    if not json:
        render.say(str(page))
        return
    for found in results.values():
        render.say_json(found)
