"""The verdict of a sweep in one line."""

import math
from collections.abc import Sequence

from hapticdb.pointshell.coverage import COVER_OF_SPACING, points_for
from hapticdb.pointshell.orientation import Surface
from hapticdb.pointshell.shell import MAX_POINTS, PointShell
from hapticdb.store.base import Object
from hapticdb.sweeps.result import Clearance, ContactDepth, MetObject, Moment, Swept
from hapticdb.units import length_text

MOST_NAMED = 3
"""Greatest number of objects that a line names; the others are only counted."""


def percent(fraction: float) -> str:
    """Write a fraction of the path, 0 .. 1, as a percentage: ``31.2 %``."""
    return f"{100 * fraction:.3g} %"


def names_of(objects: Sequence[Object]) -> str:
    """Names of objects in one phrase, `MOST_NAMED` at most: ``seat, belt, door and 4 more``."""
    names = [obj.name for obj in objects]
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def verdict_line(found: Swept, shell: PointShell) -> str:
    """Say in one line whether the tool comes out, the first obstacle, or what would decide it.

    shell : the tool of the sweep, with its covering radius if that is known.
    """
    line = _line(found, shell)
    if found.left_at_start:
        line += f"; left out, since touched at the start: {names_of(found.left_at_start)}"
        line += "".join(f"; in {one.object.name} {depth_text(one)}" for one in _told(found.depths))
    if found.is_clear_beside and found.verdict == "not decided":
        line += f"; {_next_for_depths(found.undecided)}"
    return line


def _next_for_depths(undecided: Sequence[ContactDepth]) -> str:
    """Say what may decide depths, or how to do without them."""
    deeper = max(one.deepest_most - one.at_start for one in undecided)
    if math.isfinite(deeper) and not any(one.why for one in undecided):
        return f"--tolerance {math.ceil(1e4 * deeper) / 10:g} may decide it"
    who = names_of([one.object for one in undecided])
    return f"let the path begin where the tool is free of {who}, or leave that out by --exclude"


def _told(depths: Sequence[ContactDepth]) -> Sequence[ContactDepth]:
    """Those that a line tells: cuts first, `MOST_NAMED` at most."""
    return sorted(depths, key=lambda one: (not one.is_cut, one.is_bounded))[:MOST_NAMED]


def depth_text(one: ContactDepth) -> str:
    """Say how deep a tool gets into an object that it touches at its start."""
    start, most = length_text(one.at_start_most), length_text(one.deepest_most)
    if one.is_cut:
        least = length_text(one.deepest)
        return f"it cuts {least} deep or more (at the start {start} at most)"
    if one.is_bounded:
        return f"no deeper than {most} (at the start {start} at most)"
    if one.why:
        return f"the depth is not decided: {one.why}"
    return (
        f"the depth is not decided: between {length_text(one.deepest)} and {most} (at the start "
        f"{start} at most)"
    )


def _line(found: Swept, shell: PointShell) -> str:
    """`verdict_line` without what was left out."""
    samples = f"{found.samples:,} sample{'s' * (found.samples > 1)}"
    if found.verdict == "comes out":
        if found.decision is not None:
            return f"comes out with at least {length_text(found.at_least)}{_closer_clause(found)}"
        return f"comes out: no hit in {samples}{_clearance_clause(found.clearance)}"
    if found.verdict == "not decided":
        if found.is_clear_beside:
            who = names_of([one.object for one in found.undecided])
            return f"not decided: meets nothing else, but how deep it goes into {who} is not proved"
        if found.hits:
            return _graze(found)
        return f"not decided: no hit in {samples}{_near_clause(found)}, but {_doubt(found, shell)}"
    if found.cuts and not found.objects and not found.enclosed:
        return f"cuts into {names_of([one.object for one in found.cuts])}"
    if not found.hits and not found.enclosed:
        return _near(found)
    left = [one for one in found.objects if one.is_left_at_once]
    obstacles = [one for one in found.objects if not one.is_left_at_once]
    within = [
        obj for obj in found.enclosed if obj.id not in {one.object.id for one in found.objects}
    ]
    said = [_obstacle_clause(found, obstacles)] if obstacles else []
    if left:
        until = percent(max(one.last for one in left))
        said.append(
            f"touches {names_of([one.object for one in left])} where it starts"
            + (
                f", until {until} of the path"
                if obstacles
                else f"; no hit after {until} of the path"
            )
        )
    if within:
        said.append(f"{names_of(within)} inside the closed tool where it starts")
        if len(said) == 1:
            said = [f"hits {said[0]}"]
    return "; ".join(said)


def _closer_clause(found: Swept) -> str:
    """Say that the samples alone would not show it."""
    if not found.hits:
        return ": proved between samples and points"
    return ", although points are in voxels of " + names_of([one.object for one in found.objects])


def _near_clause(found: Swept) -> str:
    """Say below which distance nothing is decided, as a clause of a line."""
    below = _below(found)
    return f", not decided{below}" if below else ""


def _below(found: Swept) -> str:
    """Say below which distance it is open how far surfaces are apart, if it is known."""
    decision = found.decision
    if decision is None or decision.is_clear or not math.isfinite(decision.within):
        return ""
    return f" below {length_text(decision.within)}"


def _graze(found: Swept) -> str:
    """Say that points are in voxels, but that surfaces are not proved near enough for a hit."""
    who = names_of([one.object for one in found.objects])
    size = length_text(0.5 * found.voxel_size)
    return (
        f"not decided{_below(found)}: grazes {who}, points are in voxels there, but no surface is "
        f"proved to come within the tolerance; voxels of {size} may decide it"
    )


def _near(found: Swept) -> str:
    """Say where surfaces are proved to be within the tolerance, though no point is in a voxel."""
    decision = found.decision
    if decision is None or decision.near is None:
        return "hits"
    who = names_of(decision.near.objects) or "an object"
    where = percent(decision.near.fraction)
    return f"hits {who} at {where} of the path: within {length_text(decision.within)}"


def _obstacle_clause(found: Swept, obstacles: Sequence[MetObject]) -> str:
    """Name the first of the obstacles: objects that the tool does not only leave at the start."""
    first_contact = found.caught
    if first_contact is None:
        first = min(one.first for one in obstacles)
        grazed = [one.object for one in obstacles if one.first == first]
        where = f"{percent(first)} of the path"
        return f"grazes {names_of(grazed)} at {where}: within a voxel, without contact"
    caught = [
        one.object
        for one in obstacles
        if one.first_contact is not None and one.first_contact.sample == first_contact.sample
    ]
    return f"is caught: first contact at {_where(found, first_contact)} with {names_of(caught)}"


def _doubt(found: Swept, shell: PointShell) -> str:
    """Say why neither verdict is proved, and what would decide it."""
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
    if found.decision is not None and found.decision.is_clear and proof.cover_needed == 0.0:
        return (
            "the tool is closed and near voxels on its whole path, so it is not known what lies "
            "inside it: let the path end where the tool is free"
        )
    moment = None if found.clearance is None else found.clearance.moment
    who = "a voxel" if moment is None else f"a voxel of {names_of(moment.objects)}"
    text = (
        f"{who} comes within {length_text(proof.nearest)} of a point, and the tool's surface "
        f"lies up to {length_text(proof.cover)} beside its points"
    )
    n_points, spacing = 0, 0.0
    if isinstance(shell.surface, Surface) and proof.cover_needed > 0.0:
        spacing = proof.cover_needed / COVER_OF_SPACING
        n_points = points_for(float(shell.surface.areas.sum()), spacing)
    if not 0 < n_points <= MAX_POINTS:
        return f"{text}: voxels of {length_text(0.5 * found.voxel_size)} may decide it"
    return (
        f"{text}: points {length_text(spacing)} apart would decide it, if none of them comes "
        f"nearer (--points {n_points})"
    )


def _clearance_clause(clearance: Clearance | None) -> str:
    if clearance is None:
        return ""
    if clearance.moment is None:
        return f", nothing nearer than {length_text(clearance.distance)}"
    return (
        f", least clearance {length_text(clearance.distance)} "
        f"from {names_of(clearance.moment.objects)}"
    )


def _where(found: Swept, moment: Moment) -> str:
    """Write a moment's place on the path: ``31 % of the path (segment 4)``."""
    segment = f" (segment {moment.segment})" if len(found.path.poses) > 2 else ""
    return f"{percent(moment.fraction)} of the path{segment}"
