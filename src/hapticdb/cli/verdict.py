"""What a sweep found, for people and for programs."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from hapticdb.cli import render

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.store.base import Object
    from hapticdb.sweeps.result import Clearance, Deepest, MetObject, Moment, Swept

MOST_OBJECTS = 20
MOST_NAMED = 3


# -- the line that says it ------------------------------------------------------------------------


def verdict_line(found: "Swept", shell: "PointShell") -> str:
    """One line: whether it comes out, what is in the way first, or what would decide."""
    samples = f"{found.samples:,} sample{'s' * (found.samples > 1)}"
    if found.verdict == "comes out":
        return f"comes out: no hit in {samples}{_clearance_clause(found.clearance)}"
    if found.verdict == "not decided":
        return f"not decided: no hit in {samples}, but {_doubt(found, shell)}"
    left = [one for one in found.objects if one.is_left_at_once]
    obstacles = [one for one in found.objects if not one.is_left_at_once]
    within = [
        obj for obj in found.enclosed if obj.id not in {one.object.id for one in found.objects}
    ]
    said = [_obstacle_clause(found, obstacles)] if obstacles else []
    if left:
        until = _percent(max(one.last for one in left))
        said.append(
            f"touches {_names([one.object for one in left])} where it starts"
            + (
                f", until {until} of the path"
                if obstacles
                else f"; no hit after {until} of the path"
            )
        )
    if within:
        said.append(f"{_names(within)} inside the closed tool where it starts")
        if len(said) == 1:
            said = [f"hits {said[0]}"]
    return "; ".join(said)


def _obstacle_clause(found: "Swept", obstacles: "Sequence[MetObject]") -> str:
    """What is in the way first, of objects that are hit elsewhere than where the path starts."""
    first_contact = found.caught
    if first_contact is None:
        first = min(one.first for one in obstacles)
        grazed = [one.object for one in obstacles if one.first == first]
        where = f"{_percent(first)} of the path"
        return f"grazes {_names(grazed)} at {where}: within a voxel, without contact"
    caught = [
        one.object
        for one in obstacles
        if one.first_contact is not None and one.first_contact.sample == first_contact.sample
    ]
    return f"is caught: first contact at {_where(found, first_contact)} with {_names(caught)}"


def _doubt(found: "Swept", shell: "PointShell") -> str:
    """Why no verdict is proved, and what would decide."""
    from hapticdb.pointshell.coverage import COVER_OF_SPACING, points_for
    from hapticdb.pointshell.orientation import Surface
    from hapticdb.pointshell.shell import MAX_POINTS

    proof = found.proof
    if proof.cover is None:
        return (
            "how well the points cover the tool is not known: give its mesh, or save the shell "
            "with its covering radius (PointShell.with_cover)"
        )
    if proof.is_clear:
        return (
            "it is not known what lies inside the closed tool where it starts: give its mesh"
            if shell.surface is None
            else "its closed tool is too large to see what lies inside it where it starts"
        )
    moment = None if found.clearance is None else found.clearance.moment
    who = "a voxel" if moment is None else f"a voxel of {_names(moment.objects)}"
    text = (
        f"{who} comes within {render.metres(proof.nearest)} of a point, and the tool's surface "
        f"lies up to {render.metres(proof.cover)} beside its points"
    )
    n_points, spacing = 0, 0.0
    if isinstance(shell.surface, Surface) and proof.cover_needed > 0.0:
        spacing = proof.cover_needed / COVER_OF_SPACING
        n_points = points_for(float(shell.surface.areas.sum()), spacing)
    if not 0 < n_points <= MAX_POINTS:
        return f"{text}: voxels of {render.metres(0.5 * found.voxel_size)} may decide it"
    return (
        f"{text}: points {render.metres(spacing)} apart would decide it, if none of them comes "
        f"nearer (--points {n_points})"
    )


def _clearance_clause(clearance: "Clearance | None") -> str:
    if clearance is None:
        return ""
    if clearance.moment is None:
        return f", nothing nearer than {render.metres(clearance.distance)}"
    return (
        f", least clearance {render.metres(clearance.distance)} "
        f"from {_names(clearance.moment.objects)}"
    )


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.3g} %"


def _where(found: "Swept", moment: "Moment") -> str:
    """Where on the path: ``31 % of the path (segment 4)``."""
    segment = f" (segment {moment.segment})" if len(found.path.poses) > 2 else ""
    return f"{_percent(moment.fraction)} of the path{segment}"


def _names(objects: "Sequence[Object]") -> str:
    names = [obj.name for obj in objects]
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


# -- for people -----------------------------------------------------------------------------------


def show(env: "Environment", found: "Swept", shell: "PointShell") -> None:
    """Print the verdict, a table of what is hit, and the figures that it stands on."""
    render.say(verdict_line(found, shell))
    if found.objects:
        rows = [
            (
                str(one.object.id),
                one.object.name,
                f"{_percent(one.first)} to {_percent(one.last)}",
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
    size = env.grid.voxel_size
    way = f"{len(found.path.poses):,} poses given, {found.samples:,} samples"
    tool = f"{len(shell):,} points, {render.metres(spacing_of(shell))} apart (median)"
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
    rate = f"{found.samples / max(found.elapsed, 1e-9):,.0f} poses a second"
    rows.append(("took", f"{found.elapsed:.2f} s, {rate}, {found.cells:,} cells fetched"))
    return rows


def _deepest_text(deepest: "Deepest", size: float) -> str:
    return (
        f"{render.metres(deepest.depth)} below a voxel's tangent plane (of "
        f"{render.metres(0.87 * size)} at most) at {_percent(deepest.moment.fraction)}, in "
        f"{_names(deepest.moment.objects)}, at {_place_text(deepest.point)} m"
    )


def _place_text(point: Iterable[float]) -> str:
    return f"({', '.join(f'{x:.4g}' for x in point)})"


def _clearance_text(clearance: "Clearance") -> str:
    """What the number means: a surface lies somewhere in its voxel, and beside the points."""
    if clearance.moment is None:
        return f"no voxel nearer than {render.metres(clearance.distance)}; farther is not looked"
    return (
        f"{render.metres(clearance.distance)} from a voxel of {_names(clearance.moment.objects)} "
        f"at {_percent(clearance.moment.fraction)}: the surfaces are "
        f"{render.metres(clearance.at_least)} to {render.metres(clearance.at_most)} apart"
    )


def spacing_of(shell: "PointShell") -> float:
    """Median distance from a point to its nearest neighbour, metres; of a thousand of them."""
    import numpy as np
    from scipy.spatial import cKDTree

    if len(shell) < 2:
        return 0.0
    some = shell.points[:: max(1, len(shell) // 1000)]
    distances, _ = cKDTree(shell.points).query(some, k=2)
    return float(np.median(np.asarray(distances)[:, 1]))


# -- for programs ---------------------------------------------------------------------------------


def record(
    found: "Swept", shell: "PointShell", parts: list[int], excluded: list[int]
) -> dict[str, Any]:
    """What `--json` prints of a sweep: metres, fractions of the path, world frame."""
    deepest, clearance, proof = found.deepest, found.clearance, found.proof
    return {
        "verdict": found.verdict,
        "comes_out": found.comes_out,
        "line": verdict_line(found, shell),
        "proof": {
            **proof._asdict(),
            "is_clear": proof.is_clear,
            "cover_needed": proof.cover_needed,
        },
        "poses": len(found.path.poses),
        "samples": found.samples,
        "hits": found.hits,
        "contacts": found.contacts,
        "first_hit": _moment(found.first_hit),
        "first_contact": _moment(found.first_contact),
        "deepest": deepest
        and {
            "depth": deepest.depth,
            "point": deepest.point.tolist(),
            "moment": _moment(deepest.moment),
        },
        "objects": [_object(one) for one in found.objects],
        "enclosed": [_named(obj) for obj in found.enclosed],
        "hit_intervals": found.hit_intervals.tolist(),
        "contact_intervals": found.contact_intervals.tolist(),
        "clearance": clearance
        and {
            "distance": clearance.distance,
            "at_least": clearance.at_least,
            "at_most": None if clearance.is_beyond else clearance.at_most,
            "is_beyond": clearance.is_beyond,
            "point": None if clearance.point is None else clearance.point.tolist(),
            "voxel": None if clearance.voxel is None else clearance.voxel.tolist(),
            "moment": _moment(clearance.moment),
        },
        "tool": {
            "points": len(shell),
            "spacing": spacing_of(shell),
            "parts": parts,
            "excluded": excluded,
        },
        "revision": found.revision,
        "elapsed": found.elapsed,
        "cells": found.cells,
    }


def _object(one: "MetObject") -> dict[str, object]:
    return {
        **_named(one.object),
        "first": one.first,
        "last": one.last,
        "intervals": one.intervals.tolist(),
        "first_contact": one.first_contact and one.first_contact.fraction,
        "length": one.length,
        "samples": one.samples,
        "contacts": one.contacts,
        "points": one.points,
        "deepest": one.deepest,
    }


def _named(obj: "Object") -> dict[str, object]:
    return {"id": obj.id, "name": obj.name}


def _moment(moment: "Moment | None") -> dict[str, object] | None:
    return moment and {
        "sample": moment.sample,
        "fraction": moment.fraction,
        "segment": moment.segment,
        "pose": moment.pose.tolist(),
        "objects": [_named(obj) for obj in moment.objects],
    }
