"""Reports of a sweep in a line: metres and fractions of the path, world frame."""

from collections.abc import Iterable, Sequence

import numpy as np

from hapticdb.exact.swept import PathPlace, Swept, TouchedObject
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object
from hapticdb.units import length_text
from hapticdb.verdicts import PathVerdict

MOST_NAMED = 3
"""Objects with a name in a line; the others are only counted."""


def percent(fraction: float) -> str:
    """Write a fraction of the path, 0 .. 1, as a percentage: ``31.2 %``."""
    return f"{100 * fraction:.3g} %"


def names_of(objects: Sequence[Object]) -> str:
    """Names of objects in one phrase, `MOST_NAMED` at most: ``seat, belt, door and 4 more``."""
    return _listed([obj.name for obj in objects])


def _listed(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def name_of(one: PathPlace | TouchedObject) -> str:
    """Name of an object, after the machine's link that meets it: ``hand and panel``."""
    return f"{one.body} and {one.object.name}" if one.body else one.object.name


def verdict_line(found: Swept, shell: PointShell | None) -> str:
    """Write the verdict in one line.

    shell : the tool, None for a machine; by its size it lies inside an object, or the object inside
    it.
    """
    if found.verdict is PathVerdict.HITS:
        late = "the time was over: what is hit before may be missing" if found.is_stopped else ""
        enclosed = () if shell is None else _enclosed_clauses(found, shell)
        clauses = [*enclosed, *_hit_clauses(found), late]
        return "; ".join(filter(None, clauses))
    if found.undecided:
        return (
            f"not decided: {names_of(found.undecided)} within the chord error of the triangles; "
            "import the STEP or IFC file with a finer --chord, such as 0.001"
        )
    if found.leaky:
        return (
            f"not decided: {names_of(found.leaky)} around the tool or inside it, and not "
            "watertight: close the holes of the mesh, or name what is no solid in --exclude"
        )
    if found.verdict is PathVerdict.NOT_DECIDED:
        return (
            "not decided: the time was over before the surfaces of all objects near the path were "
            "measured; give more --seconds"
        )
    clauses = [*_touching_clauses(found), *_cloud_clauses(found)]
    return "; ".join([_free_clause(found) + overlaps_text(found), *clauses])


def overlaps_text(found: Swept) -> str:
    """Write the overlaps of the part at the start, the greatest first."""
    said = _listed([f"{name_of(one)} {length_text(one.start)}" for one in found.overlapping])
    return f", but for overlaps at the start: {said}" if said else ""


def gap_text(found: Swept) -> str:
    """Write the proved gap: ``0.4 mm``, ``more than 0.5 m``, or ``-`` if it has no bound."""
    gap = found.gap
    if gap.place is not None:
        return length_text(gap.at_least)
    return f"more than {length_text(gap.at_least)}" if np.isfinite(gap.at_least) else "-"


def where_text(found: Swept, place: PathPlace) -> str:
    """Write a place on the path: ``31.2 % of the path (segment 4)``."""
    segment = f" (segment {place.segment})" if len(found.path.parameters) > 2 else ""
    return f"{percent(place.fraction)} of the path{segment}"


def until_text(fraction: float) -> str:
    """Write until when something lasts: ``until 12 % of the path``."""
    return f"until {percent(fraction)} of the path" if fraction < 1.0 else "to the end of the path"


def hit_text(found: Swept, place: PathPlace) -> str:
    """Write the kind and the place of a hit."""
    where, name = f"at {where_text(found, place)}", place.object.name
    depth = f": at least {length_text(place.at_least)}" if place.at_least else ""
    link = f"{place.body} " if place.body else ""
    if link and any(one is place.object for one in found.enclosed):
        return f"{link}lies inside {name}, or around it"
    for one in found.touching:
        if (one.object.id, name_of(one)) != (place.object.id, name_of(place)):
            continue
        if not one.by:
            return f"{link}starts inside {name}{depth}"
        if one.until != place.fraction:
            return f"{link}leaves {name} and hits it again {where}"
        return f"{link}goes into {name} {where}{depth or ' by more than the tolerance'}"
    return f"{link}hits {name} {where}"


def is_around(obj: Object, found: Swept, shell: PointShell) -> bool:
    """Whether an enclosed object is around the tool; else it is inside the tool."""
    pose = found.path.poses[0]
    outline = shell.outline @ pose[:3, :3].T + pose[:3, 3]
    tool = float(np.linalg.norm(np.ptp(outline, axis=0)))
    return float(np.linalg.norm(obj.bounds[1] - obj.bounds[0])) > tool


def _enclosed_clauses(found: Swept, shell: PointShell) -> Iterable[str]:
    is_outer = [is_around(obj, found, shell) for obj in found.enclosed]
    around = [obj for obj, outer in zip(found.enclosed, is_outer, strict=True) if outer]
    inside = [obj for obj, outer in zip(found.enclosed, is_outer, strict=True) if not outer]
    if around:
        yield f"lies inside {names_of(around)}"
    if inside:
        verb = "lies" if len(inside) == 1 else "lie"
        yield f"{names_of(inside)} {verb} inside the tool"


def _hit_clauses(found: Swept) -> Iterable[str]:
    if found.hits:
        yield hit_text(found, found.hits[0])
    if len(found.hits) > 1:
        yield f"then {_listed([name_of(place) for place in found.hits[1:]])}"


def _free_clause(found: Swept) -> str:
    """Write the sliding of the tool, if any, and its gap from all untouched objects.

    The gap is the least one of the whole path, so also of other objects during the sliding.
    """
    sliding = [one for one in found.touching if one.is_sliding]
    clear = _clear_clause(found)
    if not sliding:
        return clear
    return f"slides along {_touched_text(sliding)}, otherwise {clear}"


def _clear_clause(found: Swept) -> str:
    gap, place = found.gap, found.gap.place
    if place is not None:
        nearest = f"nearest {name_of(place)} at {where_text(found, place)}"
        return f"clear by {length_text(gap.at_least)}: {nearest}{error_text(gap.error)}"
    if np.isfinite(gap.at_least):
        return f"clear: nothing nearer than {length_text(gap.at_least)}"
    return "clear: nothing else is there"


def error_text(error: float) -> str:
    """Write the chord errors of a length; empty without any."""
    return f", ±{length_text(error)} by tessellation" if error else ""


def _touching_clauses(found: Swept) -> Iterable[str]:
    resting = [one for one in found.touching if not one.is_sliding]
    if resting:
        yield f"touches {_touched_text(resting)}"


def _cloud_clauses(found: Swept) -> Iterable[str]:
    """Write the meaning of a free path among points."""
    if found.clouds and found.cloud_radius:
        radius = length_text(found.cloud_radius)
        yield f"the points of {names_of(found.clouds)} are balls of radius {radius}"
    elif found.clouds:
        gap = length_text(found.gap.at_least)
        yield f"{names_of(found.clouds)}: no point within {gap}, and nothing proved between points"


def _touched_text(touched: Sequence[TouchedObject]) -> str:
    last = max(one.until for one in touched)
    return f"{_listed([name_of(one) for one in touched])} {until_text(last)}"
