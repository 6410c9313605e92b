"""The verb sweep."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from hapticdb.cli import fitting, render
from hapticdb.cli.choosing import Exclude, Parts, ids_of
from hapticdb.cli.root import Budget, Json, PathUnit, Seed, ToolUnit, UpName, Url, bytes_of
from hapticdb.cli.verbs.touching import shell_of
from hapticdb.cli.verdict import show

EXIT_CODES = {"comes out": 0, "hits": 1, "not decided": 3}
DOUBTFUL = 3
"""Exit code of "comes out", too, where tool, path and scene do not fit."""
DENSE = 0.5
"""Voxels from point to point of the tool, unless --points are given."""


def sweep(
    url: Url,
    *,
    tool: Annotated[
        str | None, typer.Option(metavar="FILE", help="Mesh of the tool, or a shell saved as .npz.")
    ] = None,
    part: Parts = None,
    path: Annotated[
        str,
        typer.Option(metavar="CSV", help="Poses x,y,z,qw,qx,qy,qz with a header."),
    ],
    exclude: Exclude = None,
    clearance: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Look so far for what is near; 0: not at all.",
            show_default="32 voxels",
        ),
    ] = None,
    budget: Budget = 256.0,
    tool_unit: ToolUnit = None,
    path_unit: PathUnit = None,
    points: Annotated[
        int | None,
        typer.Option(metavar="N", help="Points of the shell.", show_default="half a voxel apart"),
    ] = None,
    seed: Seed = None,
    as_given: Annotated[
        bool,
        typer.Option(
            "--as-given", help="Sizes and places are as they should be: exit code 0 or 1."
        ),
    ] = False,
    picture: Annotated[
        str | None, typer.Option(metavar="PNG", help="Draw the path, its hits and clearance.")
    ] = None,
    up: Annotated[
        UpName | None,
        typer.Option(help="Axis that points up in the picture.", show_default="the files'"),
    ] = None,
    json: Json = False,
) -> None:
    """Say whether a tool or part comes out along a path: what it hits, where, how near it comes.

    Hits: a point of the tool is in a voxel of an object, or something lies inside
    the tool, whose mesh is closed there. Comes out: proved for the whole surface
    and the whole path. Not decided: neither, and the line says what would decide.

    Between two poses the tool's middle moves straight while the tool turns about
    it, in steps in which no point moves more than half a voxel. Segment 0 leads
    from pose 0 to pose 1.

    With --part, objects are the tool: all of them together, rigid, left out of
    what is felt. The poses are displacements from where they sit: x,y,z 0 and
    qw 1 is their place. A sub-assembly's name means all that is below it;
    'hapticdb objects --help' says how names choose objects.

    The points are half a voxel apart, 200,000 at most, unless --points are given.

    The exit code is 0 when it comes out, 1 when it hits, 3 when not decided; 3,
    too, when it comes out, but the sizes or places of tool, path and scene do not
    fit, as a line then says: --as-given if they are meant so.

    Example: hapticdb sweep car.db --part 17 --path out.csv --picture out.png
    """
    import hapticdb
    from hapticdb.errors import UsageError
    from hapticdb.poses import read_poses
    from hapticdb.sweeps.record import sweep_record
    from hapticdb.sweeps.run import sweep as swept_by
    from hapticdb.sweeps.verdict import verdict_line

    if (tool is None) == (not part):
        raise UsageError("give one of --tool and --part")
    if part and tool_unit is not None:
        raise UsageError("--tool-unit is of a --tool; a part has the unit that it was imported in")
    if picture is not None and Path(picture).suffix.lower() != ".png":
        raise UsageError(f"--picture {picture!r}: give a name that ends with .png")
    budget_bytes = bytes_of(budget)
    poses = read_poses(path, unit=path_unit or "m")
    with hapticdb.open(url, read_only=True) as env:
        parts = ids_of(env, part, "--part")
        excluded = sorted({*parts, *ids_of(env, exclude, "--exclude")})
        render.compile_kernels("sweep", files=[tool] if tool else [])
        spacing = DENSE * env.grid.voxel_size if points is None else None
        with _bar("spreading points"):
            if tool is not None:
                shell = shell_of(tool, tool_unit, points, seed, spacing)
            else:
                shell = env.shell(*parts, points=points, spacing=spacing, seed=seed or 0)
            shell = shell.with_cover()
        fit = fitting.compare(
            env, shell, poses, exclude=excluded, tool=tool, tool_unit=tool_unit,
            path_unit=path_unit, is_moving=True,
        )  # fmt: skip
        with _bar("sweeping") as progress:
            found = swept_by(
                env,
                shell,
                poses,
                exclude=excluded,
                budget_bytes=budget_bytes,
                clearance_limit=clearance,
                profile=picture is not None,
                proportions=fit,
                progress=progress,
            )
        if env.store.revision() != found.revision:
            render.note(f"{env.url} was written meanwhile; this is of revision {found.revision}")
        try:
            if json:
                render.say_json(sweep_record(found, shell, parts, excluded))
            else:
                show(env, found, shell)
        finally:  # also when who reads, such as head, has enough
            if picture is not None:
                from hapticdb.pictures.sweep import draw_sweep

                draw_sweep(
                    picture, env, shell, found, exclude=excluded,
                    verdict=verdict_line(found, shell), up=up,
                )  # fmt: skip
    if not json and picture is not None:
        render.say(f"picture: {picture}")
    if found.verdict != "comes out":
        raise typer.Exit(EXIT_CODES[found.verdict])
    if fit.misfits and not as_given:
        raise typer.Exit(DOUBTFUL)


@contextmanager
def _bar(what: str) -> Iterator[Callable[[int, int], None] | None]:
    """Show a bar with samples a second and time left; nothing where nobody looks."""
    import sys

    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(file=sys.stderr), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
