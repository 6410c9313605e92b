"""The result of a search for a way out, or for an order, in one line."""

from hapticdb.extraction.disassembly.result import Disassembly, FailedSearch
from hapticdb.extraction.result import Extraction, WayOut
from hapticdb.store.base import Object
from hapticdb.sweeps.verdict import depth_text, names_of, verdict_line
from hapticdb.units import length_text


def extraction_line(found: Extraction) -> str:
    """Say in one line whether the parts come out, how, and what is proved; or what blocks them."""
    way = found.way
    if way is None:
        return _no_way(found)
    how = "straight" if way.how == "pull" else f"by {len(way.poses)} poses"
    if way.cuts:
        depths = "; ".join(f"in {one.object.name} {depth_text(one)}" for one in way.cuts)
        return f"not decided: a path {how}, {length_text(way.length)} long, is refuted: {depths}"
    if way.verdict == "not decided":
        return (
            f"not decided: a path {how}, {length_text(way.length)} long, is not proved: "
            f"{verdict_line(way.swept, found.shell)}"
        )
    clearance = f", surfaces {length_text(way.clearance)} or more apart" if way.clearance else ""
    if way.verdict == "comes out":
        return f"comes out {how}, {length_text(way.length)}{clearance}"
    if way.verdict == "slides out":
        depths = "; ".join(f"in {one.object.name} {depth_text(one)}" for one in way.depths)
        return (
            f"comes out {how}, {length_text(way.length)}; while it leaves what it touches: {depths}"
        )
    return (
        f"comes out {how}, {length_text(way.length)}, once it has left {_touched(way)}, which it "
        f"touches at its start: proved from {length_text(way.rest_from)} on, not before{clearance}"
    )


def _touched(way: WayOut) -> str:
    return names_of([one.object for one in way.swept.objects])


def _no_way(found: Extraction) -> str:
    pulls = f"{found.pulls} straight pull{'s' * (found.pulls != 1)}"
    tried = f"{pulls} and {found.motions:,} motions" if found.is_planned else pulls
    if found.is_planned and not found.motions:
        tried = f"{pulls}, none of which gets free of what it touches"
    if not found.blockers:
        return f"no way found in {tried}"
    first = found.blockers[0]
    others = names_of([one.object for one in found.blockers[1:]])
    return f"no way found in {tried}: {first.object.name} blocks {first.pulls} of the pulls" + (
        f", then {others}" if others else ""
    )


def disassembly_line(found: Disassembly) -> str:
    """Say in one line after what the parts come out, or what blocks them and what was tried."""
    if not found.is_found:
        return _no_order(found)
    last = extraction_line(found.steps[-1].found)
    before = _taken_off(found)[: -len(found.parts)]
    if not before:
        return f"nothing has to come out before: {last}"
    if found.verdict == "comes out":
        return f"comes out after {names_of(before)}, each step proved: {last}"
    return f"comes out after {names_of(before)}, not every step proved while in contact: {last}"


def failed_line(failed: FailedSearch) -> str:
    """Say in one line why a search proved no path."""
    if failed.reason:
        return failed.reason
    who = names_of([one.object for one in failed.blockers])
    said = "no way found" if failed.verdict is None else str(failed.verdict)
    return f"{said}: blocked by {who}" if who else said


def _no_order(found: Disassembly) -> str:
    tried = f"no order found in {len(found.failed) + len(found.steps)} searches"
    if found.is_out_of_time:
        tried += ", the time is over"
    blockers = names_of([one.object for one in found.blockers])
    said = f"{tried}: blocked by {blockers}" if blockers else tried
    taken = _taken_off(found)
    return said + (f"; taken off in vain: {names_of(taken)}" if taken else "")


def _taken_off(found: Disassembly) -> list[Object]:
    return [obj for step in found.steps for obj in step.found.parts]
