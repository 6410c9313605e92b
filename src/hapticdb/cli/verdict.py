"""What a sweep found, printed for people."""

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from hapticdb.cli import render

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.sweeps.result import Clearance, Decision, Deepest, Swept

MOST_OBJECTS = 20
"""Rows of the table; the other objects are counted below it."""


def show(env: "Environment", found: "Swept", shell: "PointShell") -> None:
    """Print the verdict, a table of what is hit, and the figures that it stands on."""
    from hapticdb.sweeps.verdict import percent, verdict_line

    render.say(verdict_line(found, shell))
    if found.objects:
        rows = [
            (
                str(one.object.id),
                one.object.name,
                f"{percent(one.first)} to {percent(one.last)}",
                render.metres(one.length),
                f"{one.samples:,}",
                f"{one.contacts:,}",
                f"{one.points:,}",
            )
            for one in found.objects[:MOST_OBJECTS]
        ]
        columns = ("id>", "hit", "of the path>", "length>", "samples>", "in contact>", "points>")
        render.show(render.table(columns, rows))
        if len(found.objects) > MOST_OBJECTS:
            render.say(f"{len(found.objects)} objects, {MOST_OBJECTS} of them shown")
    render.show(render.facts(_facts(env, found, shell)))


def _facts(env: "Environment", found: "Swept", shell: "PointShell") -> list[tuple[str, str]]:
    from hapticdb.sweeps.record import median_spacing
    from hapticdb.sweeps.verdict import depth_text

    size = env.grid.voxel_size
    way = f"{len(found.path.poses):,} poses given, {found.samples:,} samples"
    tool = f"{len(shell):,} points, {render.metres(median_spacing(shell))} apart (median)"
    if found.proof.cover is not None:
        tool += f", none of its surface more than {render.metres(found.proof.cover)} from one"
    rows = [
        ("path", f"{way}, no point moves more than {render.metres(0.5 * size)} between two"),
        ("tool", tool),
        ("hits", f"{found.hits:,} samples hit, {found.contacts:,} in contact"),
    ]
    if found.deepest is not None and found.deepest.depth > 0.0:
        rows.append(("tangent depth", _deepest_text(found.deepest, size)))
    if found.clearance is not None and not found.hits:
        rows.append(("clearance", _clearance_text(found.clearance)))
    rows += [(f"in {one.object.name}", depth_text(one)) for one in found.depths[:MOST_OBJECTS]]
    if found.decision is not None:
        rows.append(("decision", _decision_text(found.decision)))
    rows.append(("looked", f"{found.looked:,} times at the points of a pose"))
    rate = f"{found.samples / max(found.elapsed, 1e-9):,.0f} poses a second"
    rows.append(("took", f"{found.elapsed:.2f} s, {rate}, {found.cells:,} cells fetched"))
    return rows


def _decision_text(decision: "Decision") -> str:
    """What a closer look has shown, and how close it was."""
    if decision.is_clear:
        text = f"surfaces keep at least {render.metres(decision.at_least)} apart"
    elif math.isfinite(decision.within):
        text = f"a surface comes within {render.metres(decision.within)}"
    else:
        text = "neither is proved"
    size = render.metres(decision.finest)
    return f"{text}, by {decision.by}, last on {decision.pieces:,} pieces within {size} of a point"


def _deepest_text(deepest: "Deepest", size: float) -> str:
    from hapticdb.sweeps.verdict import names_of, percent

    return (
        f"{render.metres(deepest.depth)} below a voxel's tangent plane (of "
        f"{render.metres(0.87 * size)} at most) at {percent(deepest.moment.fraction)}, in "
        f"{names_of(deepest.moment.objects)}, at {_place_text(deepest.point)} m"
    )


def _place_text(point: Iterable[float]) -> str:
    return f"({', '.join(f'{x:.4g}' for x in point)})"


def _clearance_text(clearance: "Clearance") -> str:
    """What the number means: a surface lies somewhere in its voxel, and beside the points."""
    from hapticdb.sweeps.verdict import names_of, percent

    if clearance.moment is None:
        return f"no voxel nearer than {render.metres(clearance.distance)}; farther is not looked"
    return (
        f"{render.metres(clearance.distance)} from a voxel of {names_of(clearance.moment.objects)} "
        f"at {percent(clearance.moment.fraction)}: the surfaces are "
        f"{render.metres(clearance.at_least)} to {render.metres(clearance.at_most)} apart"
    )
