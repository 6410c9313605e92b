"""The verbs that copy and compare environments: copy, diff."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from hapticdb.cli import render
from hapticdb.cli.options import JsonOption, SameCurveOption, SameLayoutOption
from hapticdb.cli.root import left_at
from hapticdb.units import length_text

if TYPE_CHECKING:
    from hapticdb.difference import Difference
    from hapticdb.store.base import Object
    from hapticdb.transfer import CopyReport

KINDS = {
    "only_in_a": "only in A", "only_in_b": "only in B", "surfaces": "another surface",
    "moved": "another place", "attributes": "other attributes", "boxes": "another box",
    "voxels": "other voxels", "distances": "other distances",
}  # fmt: skip
"""Kinds of differences, the most important first, by their names in JSON."""
MOST_LINES = 20
"""Differences that are listed; more are counted."""


def copy(
    source: Annotated[str, typer.Argument(metavar="SRC", help="The environment to copy.")],
    target: Annotated[
        str, typer.Argument(metavar="DST", help="Made when it does not exist; of any engine.")
    ],
    *,
    layout: SameLayoutOption = None,
    curve: SameCurveOption = None,
    json: JsonOption = False,
) -> None:
    """Copy an environment, also to another engine, layout or curve.

    Every object goes over in a transaction of its own, with its id: run the
    same command again to go on with what was interrupted. What is edited
    meanwhile is not copied.

    Example: hapticdb copy car.db hilbert.db --curve hilbert
    """
    from hapticdb.transfer import copy_environment

    with (
        left_at("what went over is whole, and the same command goes on from there"),
        render.bar("copying", "objects") as progress,
    ):
        report = copy_environment(source, target, layout=layout, curve=curve, progress=progress)
    if json:
        render.say_json(vars(report))
    else:
        render.say(_copied(report))
        if layout == "voxel":
            render.note("the layout voxel has no distances: it has the law plane alone")


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
    json: JsonOption = False,
) -> None:
    """Say whether two environments hold the same, and what differs.

    Objects are the same by file and name. Their surfaces, places, attributes,
    boxes and rows are compared; rows only where surface and place are the same,
    and distances where both have them. The exit code is 0 when they hold the
    same, 1 when they differ. Ids, engine, layout and curve make no difference.

    Example: hapticdb diff car.db hilbert.db
    """
    from hapticdb.difference import diff_environments

    with render.bar("comparing", "rows") as progress:
        difference = diff_environments(a, b, progress=progress)
    record = _record(difference)
    if json:
        render.say_json(record)
    elif difference.is_equal:
        render.say(_equal(difference))
    else:
        _show(difference, record)
    if not difference.is_equal:
        raise typer.Exit(1)


def _record(difference: "Difference") -> dict[str, Any]:
    from hapticdb.difference import farthest_corner, moved_by

    size = difference.grids[0].voxel_size

    def named(obj: "Object") -> dict[str, object]:
        return {"id": obj.id, "name": obj.name, "link": obj.link}

    def amount(a: "Object", b: "Object") -> dict[str, object]:
        farthest = farthest_corner(a, b)
        return named(a) | {
            "moved_by": moved_by(a, b).tolist(),
            "farthest_corner": farthest,
            "farthest_corner_voxels": farthest / size,
        }

    lone = {kind: [named(obj) for obj in getattr(difference, kind)] for kind in [*KINDS][:2]}
    both = {kind: [amount(*pair) for pair in getattr(difference, kind)] for kind in [*KINDS][2:]}
    return {
        "equal": difference.is_equal,
        "a": difference.a,
        "b": difference.b,
        "same_grid": difference.is_same_grid,
        **lone,
        **both,
        "with_distances": list(difference.with_distances),
        "renumbered": [named(obj) | {"id_in_b": other.id} for obj, other in difference.renumbered],
        "objects_compared": difference.compared,
        "voxels_compared": difference.n_voxels,
    }


def _equal(difference: "Difference") -> str:
    line = (
        f"{difference.a} and {difference.b} hold the same: "
        f"{render.counted(difference.compared, 'object')}, "
        f"{render.counted(difference.n_voxels, 'voxel')}, {difference.grids[0].side}^3 cells of "
        f"{length_text(difference.grids[0].voxel_size)}"
    )
    in_a, in_b = difference.with_distances
    if in_a == in_b:
        line += f", {render.counted(in_a, 'object')} with distances" if in_a else ""
    else:
        line += f"; distances of {render.counted(in_a, 'object')} in A, of {in_b:,} in B"
    if difference.renumbered:
        line += f"; {render.counted(len(difference.renumbered), 'object')} with other ids"
    return line


def _show(difference: "Difference", record: dict[str, Any]) -> None:
    """Print differences, a row each, the most important first."""
    a, b = difference.a, difference.b
    if not difference.is_same_grid:
        grid_a, grid_b = (grid.describe() for grid in difference.grids)
        render.say(
            f"other grids, so that rows cannot be compared: {grid_a} in {a}; {grid_b} in {b}"
        )
    rows = [_row(kind, one) for kind in KINDS for one in record[kind]]
    if rows:
        render.table(("id>", "name", "what", "moved by>", "file"), rows[:MOST_LINES])
        render.say(f"A: {a}; B: {b}")
    count = render.counted(len(rows) + (not difference.is_same_grid), "difference")
    cut = "" if len(rows) <= MOST_LINES else f", {MOST_LINES} of them shown"
    render.say(f"{count}{cut}")


def _row(kind: str, one: dict[str, Any]) -> tuple[str, ...]:
    """Row of the table for an entry of the record."""
    way = one.get("farthest_corner", 0.0)
    moved = f"{length_text(way)} ({one['farthest_corner_voxels']:.3g} voxels)" if way else ""
    return str(one["id"]), one["name"], KINDS[kind], moved, one["link"]
