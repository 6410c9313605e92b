"""Verbs for two environments: copy, diff."""

from functools import partial
from typing import TYPE_CHECKING, Any

import typer

from hapticdb.cli import render
from hapticdb.cli.emit import Output
from hapticdb.cli.options import CurveName, LayoutName
from hapticdb.cli.root import left_at
from hapticdb.tabular.schema import plain, record
from hapticdb.units import length_text

if TYPE_CHECKING:
    from hapticdb.difference import Difference
    from hapticdb.transfer import CopyReport

KINDS = {
    "only_in_a": "only in A", "only_in_b": "only in B", "surfaces": "another surface",
    "moved": "another place", "attributes": "other attributes", "boxes": "another box",
    "voxels": "other voxels", "distances": "other distances",
}  # fmt: skip
"""Fields of a `Difference`, the most important first, with their words for an object."""


def copy(
    source: str, target: str, *, layout: LayoutName | None = None, curve: CurveName | None = None,
    output: Output,
) -> None:  # fmt: skip
    """Copy to another engine, layout or curve.

    Every object is copied in a transaction of its own, with its id: after an interruption, run the
    same command again to continue. Edits made meanwhile are not copied.

    Example: hapticdb copy car.db hilbert.db --curve hilbert
    """
    from hapticdb.transfer import copy_environment

    with (
        left_at("what went over is whole, and the same command goes on from there"),
        render.bar("copying", "objects") as progress,
    ):
        report = copy_environment(source, target, layout=layout, curve=curve, progress=progress)
    output.emit(report, _copied(report))
    if layout == "voxel":
        render.note("the layout voxel has no distances: it has the law plane alone")


def _copied(report: "CopyReport") -> str:
    there = render.counted(report.present, "object")
    if not report.copied:
        return f"{report.target}: complete already ({there}), nothing to do"
    copied, voxels = render.counted(report.copied, "object"), render.counted(report.voxels, "voxel")
    line = f"{report.target}: {copied} copied, {voxels}"
    if report.present:
        line += f"; {report.present} were there already"
    if report.renumbered:
        line += f"; {report.renumbered} under another id, since their own was taken"
    return line


def diff(a: str, b: str, *, output: Output) -> None:
    """Compare two environments.

    Objects are paired by file and name. Their surfaces, places, attributes, boxes and rows are
    compared; rows only if surface and place are the same, and distances if both have them. The exit
    code is 0 if the environments are equal, 1 if they differ. Ids, engine, layout and curve do not
    matter.

    Example: hapticdb diff car.db hilbert.db
    """
    from hapticdb.difference import diff_environments

    with render.bar("comparing", "rows") as progress:
        difference = diff_environments(a, b, progress=progress)
    differences = _record(difference)
    shown = partial(_show, difference, differences["differences"])
    output.emit(differences, _equal(difference) if difference.is_equal else shown, 0)
    if not difference.is_equal:
        raise typer.Exit(1)


def _record(found: "Difference") -> dict[str, Any]:
    from hapticdb.difference import farthest_corner, moved_by

    differences: list[dict[str, Any]] = []
    for kind, what in KINDS.items():
        for one in getattr(found, kind):
            pair = one if isinstance(one, tuple) else (one,)
            differences.append({"what": what} | record(pair[0], "id name link"))
            if len(pair) == 2:
                differences[-1]["moved_by"] = moved_by(*pair)
                differences[-1]["farthest_corner"] = farthest_corner(*pair)
    return {**plain(found), "differences": differences}


def _equal(difference: "Difference") -> str:
    held = render.counts(object=difference.compared, voxel=difference.n_voxels)
    grid = difference.grids[0]
    line = f"{difference.a} and {difference.b} hold the same: {held}, {grid.side}^3 cells of "
    line += length_text(grid.voxel_size)
    in_a, in_b = difference.with_distances
    if in_a == in_b:
        line += f", {render.counted(in_a, 'object')} with distances" if in_a else ""
    else:
        line += f"; distances of {render.counted(in_a, 'object')} in A, of {in_b:,} in B"
    if difference.renumbered:
        line += f"; {render.counted(len(difference.renumbered), 'object')} with other ids"
    return line


def _show(found: "Difference", differences: list[dict[str, Any]]) -> None:
    """Print differences, a row each, the most important first."""
    size = found.grids[0].voxel_size
    if not found.is_same_grid:
        grid_a, grid_b = (grid.describe() for grid in found.grids)
        render.say(
            f"other grids, so that rows cannot be compared: {grid_a} in {found.a}; {grid_b} in "
            f"{found.b}"
        )
    rows = []
    for one in differences[: render.MOST_ROWS]:
        distance = one.get("farthest_corner")
        moved = f"{length_text(distance)} ({distance / size:.3g} voxels)" if distance else ""
        rows.append((one["id"], one["name"], one["what"], moved, one["link"]))
    render.table(("id>", "name", "what", "moved by>", "file?"), rows)
    if rows:
        render.say(f"A: {found.a}; B: {found.b}")
    count = render.counted(len(differences) + (not found.is_same_grid), "difference")
    cut = f", {render.MOST_ROWS} of them shown" if len(differences) > render.MOST_ROWS else ""
    render.say(count + cut, 1)
