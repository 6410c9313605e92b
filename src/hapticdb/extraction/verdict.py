"""The result of a search for a way out in one line."""

from hapticdb.extraction.result import Extraction, WayOut
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
