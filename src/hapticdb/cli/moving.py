"""The verbs of moving house: copy, diff."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.root import CurveName, Interrupted, Json, LayoutName

if TYPE_CHECKING:
    from hapticdb.difference import Difference
    from hapticdb.store.base import Object
    from hapticdb.transfer import CopyReport

MOST_LINES = 20


def copy(
    source: Annotated[str, typer.Argument(metavar="SRC", help="The environment to copy.")],
    target: Annotated[
        str, typer.Argument(metavar="DST", help="Made when it does not exist; of any engine.")
    ],
    *,
    layout: Annotated[
        LayoutName | None,
        typer.Option(help="Index table of a new environment.", show_default="that of SRC"),
    ] = None,
    curve: Annotated[
        CurveName | None,
        typer.Option(help="Order of the keys of a new one.", show_default="that of SRC"),
    ] = None,
    json: Json = False,
) -> None:
    """Copy an environment, also to another engine, layout or curve.

    Every object goes over in a transaction of its own, with its id: run the
    same command again to go on with what was interrupted. What is edited
    meanwhile is not copied.

    Example: hapticdb copy car.db hilbert.db --curve hilbert
    """
    from hapticdb.transfer import copy_environment

    try:
        render.compile_kernels("copy")
        with render.copy_bar("copying") as progress:
            report = copy_environment(source, target, layout=layout, curve=curve, progress=progress)
    except KeyboardInterrupt:
        raise Interrupted(
            "interrupted; what went over is whole, and the same command goes on from there"
        ) from None
    if json:
        render.say_json(vars(report))
    else:
        render.say(_copied(report))


def _copied(report: "CopyReport") -> str:
    there = render.counted(report.present, "object")
    if not report.copied:
        return f"{report.target}: complete already ({there}), nothing to do"
    line = (
        f"{report.target}: {render.counted(report.copied, 'object')} copied, "
        f"{render.counted(report.voxels, 'voxel')}"
    )
    if report.present:
        line += f"; {report.present} were there already"
    if report.renumbered:
        line += f"; {report.renumbered} under another id, since their own was taken"
    return line


def diff(
    a: Annotated[str, typer.Argument(metavar="A", help="An environment.")],
    b: Annotated[str, typer.Argument(metavar="B", help="Another one; of any engine.")],
    *,
    json: Json = False,
) -> None:
    """Say whether two environments hold the same objects and voxels.

    The exit code is 0 when they do, 1 when they differ. Engine, layout and
    curve make no difference.

    Example: hapticdb diff car.db hilbert.db
    """
    from hapticdb.difference import diff_environments

    render.compile_kernels("copy")
    with render.copy_bar("comparing") as progress:
        difference = diff_environments(a, b, progress=progress)
    if json:
        render.say_json(_record(difference))
    elif difference.is_equal:
        render.say(_equal(difference))
    else:
        lines = list(_lines(difference))
        for line in lines[:MOST_LINES]:
            render.say(line)
        count = render.counted(len(lines), "difference")
        render.say(count if len(lines) <= MOST_LINES else f"{count}, {MOST_LINES} of them shown")
    if not difference.is_equal:
        raise typer.Exit(1)


def _record(difference: "Difference") -> dict[str, object]:
    def named(obj: "Object") -> dict[str, object]:
        return {"id": obj.id, "name": obj.name, "link": obj.link}

    return {
        "equal": difference.is_equal,
        "a": difference.a,
        "b": difference.b,
        "same_grid": difference.is_same_grid,
        "only_in_a": [named(obj) for obj in difference.only_in_a],
        "only_in_b": [named(obj) for obj in difference.only_in_b],
        "changed": [named(obj) for obj, _ in difference.changed],
        "moved": [named(obj) for obj, _ in difference.moved],
        "voxels": [
            named(found.a) | {"only_in_a": found.only_in_a, "only_in_b": found.only_in_b}
            for found in difference.voxels
        ],
        "renumbered": [named(obj) | {"id_in_b": other.id} for obj, other in difference.renumbered],
        "described": [named(obj) for obj, _ in difference.described],
        "objects_compared": difference.compared,
        "voxels_compared": difference.n_voxels,
    }


def _equal(difference: "Difference") -> str:
    line = (
        f"{difference.a} and {difference.b} hold the same: "
        f"{render.counted(difference.compared, 'object')}, "
        f"{render.counted(difference.n_voxels, 'voxel')}, {difference.grids[0].side}^3 cells of "
        f"{render.metres(difference.grids[0].voxel_size)}"
    )
    if difference.renumbered:
        line += f"; {render.counted(len(difference.renumbered), 'object')} with other ids"
    if difference.described:
        line += f"; {render.counted(len(difference.described), 'object')} with other attributes"
    return line


def _lines(difference: "Difference") -> Iterator[str]:
    """Differences, most important first, a line each."""
    a, b = difference.a, difference.b
    if not difference.is_same_grid:
        grid_a, grid_b = (grid.describe() for grid in difference.grids)
        yield f"other grids, so that voxels cannot be compared: {grid_a} in {a}; {grid_b} in {b}"
    for url, objects in ((a, difference.only_in_a), (b, difference.only_in_b)):
        for obj in objects:
            yield f"only in {url}: object {obj.id} ({obj.name}) of {obj.link}"
    for obj, _ in difference.changed:
        yield f"other geometry: object {obj.id} ({obj.name}) of {obj.link}"
    for obj, _ in difference.moved:
        yield f"another place: object {obj.id} ({obj.name}) of {obj.link}"
    for obj, _, only_a, only_b in difference.voxels:
        yield (
            f"other voxels: object {obj.id} ({obj.name}): "
            f"{only_a:,} only in {a}, {only_b:,} only in {b}"
        )
