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

SIDES = ("only_in_a", "only_in_b")
KINDS = {
    "only_in_a": "only in A", "only_in_b": "only in B", "changed": "other geometry",
    "moved": "another place", "voxels": "other voxels", "distances": "other distances",
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

    with left_at("what went over is whole, and the same command goes on from there"):
        render.compile_kernels("copy")
        with render.bar("copying", "objects") as progress:
            report = copy_environment(source, target, layout=layout, curve=curve, progress=progress)
    if json:
        render.say_json(vars(report))
    else:
        render.say(_copied(report))
        if layout == "voxel":
            render.note("the layout voxel has no distances, so the smooth law cannot be felt there")


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
    """Say whether two environments hold the same objects and voxels, and by how much they differ.

    For each object that differs: voxels that only A has, only B, the share that
    both have, and how far a corner of its bounding box has moved at most.
    Distances to surfaces are compared where both have them. The
    exit code is 0 when they hold the same, 1 when they differ. Engine, layout
    and curve make no difference.

    Example: hapticdb diff car.db hilbert.db
    """
    from hapticdb.difference import diff_environments

    render.compile_kernels("copy")
    with render.bar("comparing", "objects") as progress:
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
    apart = {one.a.id: one for one in (*difference.voxels, *difference.elsewhere)}

    def named(obj: "Object") -> dict[str, object]:
        return {"id": obj.id, "name": obj.name, "link": obj.link}

    def amount(a: "Object", b: "Object") -> dict[str, object]:
        one, farthest = apart.get(a.id), farthest_corner(a, b)
        counts = {"only_in_a": None, "only_in_b": None, "shared": None, "share": None}
        if one is not None:
            counts = {name: getattr(one, name) for name in counts}
        moved = {"moved_by": moved_by(a, b).tolist(), "farthest_corner": farthest}
        return named(a) | counts | moved | {"farthest_corner_voxels": farthest / size}

    totals = difference.totals
    return {
        "equal": difference.is_equal,
        "a": difference.a,
        "b": difference.b,
        "same_grid": difference.is_same_grid,
        "only_in_a": [named(obj) | {"voxels": obj.voxels} for obj in difference.only_in_a],
        "only_in_b": [named(obj) | {"voxels": obj.voxels} for obj in difference.only_in_b],
        "changed": [amount(*pair) for pair in difference.changed],
        "moved": [amount(*pair) for pair in difference.moved],
        "voxels": [amount(one.a, one.b) for one in difference.voxels],
        "distances": [named(one.a) | {"rows": one.n_rows} for one in difference.distances],
        "with_distances": list(difference.with_distances),
        "renumbered": [named(obj) | {"id_in_b": other.id} for obj, other in difference.renumbered],
        "described": [named(obj) for obj, _ in difference.described],
        "objects_compared": difference.compared,
        "voxels_compared": difference.n_voxels,
        "totals": None if totals is None else totals._asdict(),
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
    if difference.described:
        line += f"; {render.counted(len(difference.described), 'object')} with other attributes"
    return line


def _show(difference: "Difference", record: dict[str, Any]) -> None:
    """Print differences, a row each, the most important first, and their totals."""
    a, b = difference.a, difference.b
    if not difference.is_same_grid:
        grid_a, grid_b = (grid.describe() for grid in difference.grids)
        render.say(
            f"other grids, so that voxels cannot be compared: {grid_a} in {a}; {grid_b} in {b}"
        )
    rows = [_row(kind, one) for kind in KINDS for one in record[kind]]
    if rows:
        headings = "id> name what only_in_A> only_in_B> shared> moved_by> file"
        render.table([word.replace("_", " ") for word in headings.split()], rows[:MOST_LINES])
        render.say(f"A: {a}; B: {b}")
    count = render.counted(len(rows) + (not difference.is_same_grid), "difference")
    cut = "" if len(rows) <= MOST_LINES else f", {MOST_LINES} of them shown"
    if (totals := difference.totals) is None:
        render.say(f"{count}{cut}")
        return
    in_all = totals.only_in_a + totals.only_in_b + totals.shared
    share = render.percent(totals.shared / in_all if in_all else 1.0)
    render.say(
        f"{count}{cut}; {render.counted(totals.only_in_a, 'voxel')} only in A, "
        f"{render.counted(totals.only_in_b, 'voxel')} only in B, "
        f"{render.counted(totals.shared, 'voxel')} shared, {share}"
    )


def _row(kind: str, one: dict[str, Any]) -> tuple[str, ...]:
    """Row of the table for an entry of the record."""
    only = [one.get(side, one.get("voxels") if side == kind else None) for side in SIDES]
    counts = ["" if n is None else f"{n:,}" for n in only]
    share, way = one.get("share"), one.get("farthest_corner", 0.0)
    moved = f"{length_text(way)} ({one['farthest_corner_voxels']:.3g} voxels)" if way else ""
    shared = "" if share is None else render.percent(share)
    return str(one["id"]), one["name"], KINDS[kind], *counts, shared, moved, one["link"]
