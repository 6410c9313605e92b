"""Verbs that measure: distance, reach."""

from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import typer

import hapticdb
from hapticdb.cli import render
from hapticdb.cli.emit import Output, TableOutput, open_csv
from hapticdb.cli.options import UnitName
from hapticdb.cli.selection import FilterOptions, as_named, ids_of
from hapticdb.cli.tool_options import tool_of, warn_of_size
from hapticdb.cli.values import Point, numbers_of
from hapticdb.tabular.schema import plain
from hapticdb.units import length_text, place_text
from hapticdb.verdicts import REACH_VERDICTS, WORST, exit_codes

if TYPE_CHECKING:
    from hapticdb.batches.exact import Distance

HELP = f"""Check from which angles a tool gets onto objects, and turns there.

The z axis of the tool lies on the axis of each object that WORDS choose, its origin (or --about) on
the end face. At each angle about the axis a sweep proves that the tool gets on by --lift, turns by
--turn and gets off without a hit. Both ends of the axis are tried; the one with more free angles is
listed. The object itself is never in the way.

Angles go round the outward axis by the right-hand rule, from where the tool's x axis points along
the scene's x, or y if the axis lies along x. Those between two steps are not decided. The gap is
the greatest of the free angles, 20 mm at most, 0 where the tool slides.

{exit_codes(REACH_VERDICTS, "Several objects have")}

Example: hapticdb reach car.db 'wheel_bolt*' --tool brace.stl --turn 90deg
"""


def reach(
    url: str, objects: list[str], *, tool: str, tool_unit: UnitName | None = None,
    axis: str | None = None, approach: Literal["x", "y", "z", "-x", "-y", "-z"] = "-z",
    about: Point | None = None, offset: float = 0.0, lift: float = 0.02, turn: float = 60.0,
    step: float = 15.0, selection: FilterOptions, contact: float = 5e-5,
    seconds: float | None = None, output: TableOutput,
) -> None:  # fmt: skip
    """See `HELP`."""
    from hapticdb.exact.reach import REACH_KEYS
    from hapticdb.exact.sweep_report import names_of

    outward = axis and numbers_of(axis, 3, "--axis", "a direction, such as 0,0,1")
    options: dict[str, Any] = {"axis": outward or None, "approach": approach, "about": about}
    options |= {"offset": offset, "lift": lift, "turn": turn, "step": step}
    with open_csv(output.csv, REACH_KEYS) as table, hapticdb.open(url, read_only=True) as env:
        ids, chosen = ids_of(env, objects, "WORDS"), selection.resolve(env)
        points = None if tool.lower().endswith(".npz") else 1
        made = tool_of(tool, tool_unit, points, None, has_surface=True)
        warn_of_size(env, made, chosen.excluded)
        with render.bar("sweeping", "targets") as progress:
            found = hapticdb.reach(
                env, ids, made.shell, where=chosen.where, exclude=chosen.exclude, contact=contact,
                seconds=seconds, progress=progress, **options,
            )  # fmt: skip
        output.add(table, *map(plain, found.targets))
    status = min((one.verdict.exit_status for one in found.targets), key=WORST.index)
    if output.has_words:
        n_reachable = sum(one.n_free > 0 for one in found.targets)
        render.say(f"{n_reachable} of {len(found.targets)} reachable", status)
        rows = (
            (one.object.id, one.object.name, one.verdict, f"{one.n_free} of {one.n_angles}",
             one.free, "-" if one.gap is None else length_text(one.gap), names_of(one.obstacles))
            for one in found.targets
        )  # fmt: skip
        columns = ("id>", "object", "is", "free>", "degrees", "gap>", "in the way")
        render.table(columns, rows, len(found.targets))
        render.facts([("took", f"{found.elapsed:.2f} s")])
    raise typer.Exit(status)


reach.__doc__ = HELP


def distance(url: str, a: str, b: str, *, output: Output) -> None:
    """Measure how far two objects are apart.

    The nearest points of their surfaces are printed. If A or B are several objects, the two nearest
    ones are measured. If surfaces meet, 'hapticdb clashes --of A --against B' measures the depth.

    Example: hapticdb distance car.db body/hood body/windscreen
    """
    with hapticdb.open(url, read_only=True) as env:
        found = env.distance(*as_named(env, [a], "A"), *as_named(env, [b], "B"))
    output.emit(found, partial(_show, found))


def _show(found: "Distance") -> None:
    length = length_text(found.at_most)
    least = f"meet, or are {length} apart at most" if found.at_most else "meet"
    apart = f"are {length} apart" if found.at_least else least
    render.say(f"{found.a.name} and {found.b.name} {apart}")
    facts = [
        (f"on {obj.name}", f"{place_text(place.tolist(), 1e-6)} m")
        for obj, place in ((found.a, found.on_a), (found.b, found.on_b))
    ]
    if found.at_most - found.at_least > 1e-3 * found.at_most:
        facts.append(("at least", f"{length_text(found.at_least)}, by chord errors"))
    render.facts(facts)
