"""Results of searches in one line."""

from hapticdb.exact.sweep_report import (
    MOST_NAMED,
    gap_text,
    names_of,
    overlaps_text,
    until_text,
    verdict_line,
)
from hapticdb.extraction.disassembly import Disassembly, FailedSearch
from hapticdb.extraction.extraction_results import Extraction, RemovalPath
from hapticdb.store.base import Object
from hapticdb.units import length_text
from hapticdb.verdicts import PathVerdict


def extraction_line(found: Extraction) -> str:
    """Verdict, path and proof of a search, or the objects in the way, in one line."""
    removal = found.path
    if removal is None:
        return _no_path(found)
    hows = {"pull": "straight", "screw": "by a screw motion"}
    how = hows.get(removal.how, f"by {len(removal.poses)} poses")
    path = f"{how}, {length_text(removal.length)}"
    if not found.is_free:
        why = verdict_line(removal.swept, found.shell).removeprefix("not decided: ")
        return f"not decided: a path, {path}: {why}{_blocked(found)}"
    does = "comes out" if removal.swept.comes_out else "slides"
    does = does if found.to is None else "reaches the pose"
    return f"{does} {path}{overlaps_text(removal.swept)}{_proved(removal)}"


def _proved(removal: RemovalPath) -> str:
    """Least distance of the surfaces, and touched objects with the ends of their contacts."""
    swept, gap = removal.swept, gap_text(removal.swept)
    said = [f"{one.object.name} {until_text(one.until)}" for one in swept.touching[:MOST_NAMED]]
    apart = "" if gap == "-" else f", surfaces {gap} apart"
    return apart + (f"; touches {', '.join(said)}" if said else "")


def _no_path(found: Extraction) -> str:
    pulls = f"{found.pulls} straight pull{'s' * (found.pulls != 1)}"
    motions = f"{found.motions:,} motion{'s' * (found.motions != 1)}"
    tried = f"{pulls} and {motions}" if found.is_planned else pulls
    if found.is_planned and not found.motions:
        tried = f"{pulls}, none of which gets free of what is near"
    said = f"no path found in {tried}"
    if found.is_out_of_time:
        said = f"not decided: the time was over; {said}; give more --seconds"
    return said + _blocked(found)


def _blocked(found: Extraction) -> str:
    """Objects that stop pulls, after a colon; empty without one."""
    if not found.blockers:
        return ""
    first = found.blockers[0]
    others = names_of([one.object for one in found.blockers[1:]])
    return f": {first.object.name} blocks {first.pulls} of the pulls" + (
        f", then {others}" if others else ""
    )


def disassembly_line(found: Disassembly) -> str:
    """Objects removed first and the last removal, or the objects in the way, in one line."""
    if not found.is_found:
        return _no_order(found)
    last = extraction_line(found.steps[-1].found)
    before = _removed_text(found)[: -len(found.parts)]
    return f"after {names_of(before)}: {last}" if before else f"nothing goes before: {last}"


def failed_line(failed: FailedSearch) -> str:
    """Reason of a failed search, in one line."""
    if failed.reason:
        return failed.reason
    who = names_of([one.object for one in failed.blockers])
    said = str(failed.verdict or PathVerdict.NO_PATH)
    return f"{said}: blocked by {who}" if who else said


def _no_order(found: Disassembly) -> str:
    n_searches = len(found.failed) + len(found.steps)
    tried = f"no order found in {n_searches} search{'es' * (n_searches != 1)}"
    if found.is_out_of_time:
        tried += ", the time is over"
    blockers = names_of([one.object for one in found.blockers])
    said = f"{tried}: blocked by {blockers}" if blockers else tried
    taken = _removed_text(found)
    return said + (f"; taken off in vain: {names_of(taken)}" if taken else "")


def _removed_text(found: Disassembly) -> list[Object]:
    return [obj for step in found.steps for obj in step.found.parts]
