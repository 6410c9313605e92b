"""A search's result for JSON: metres, displacements, world frame."""

from typing import Any

from hapticdb.extraction.result import Extraction, WayOut
from hapticdb.extraction.verdict import extraction_line
from hapticdb.pointshell.shell import PointShell
from hapticdb.sweeps.record import depth_record, named, sweep_record
from hapticdb.sweeps.result import Swept


def extraction_record(found: Extraction, excluded: list[int]) -> dict[str, Any]:
    """Convert a result to numbers and strings, as `hapticdb extract --json` prints it.

    excluded : ids of the objects that were left out, those of the parts among them.
    """
    parts = [obj.id for obj in found.parts]
    return {
        "verdict": found.verdict,
        "line": extraction_line(found),
        "parts": [named(obj) for obj in found.parts],
        "way": found.way and _way(found.way, found.shell, parts, excluded),
        "touched": [named(obj) for obj in found.touched],
        "blockers": [{**named(one.object), "pulls": one.pulls} for one in found.blockers],
        "pulls": found.pulls,
        "motions": found.motions,
        "poses": found.poses,
        "is_planned": found.is_planned,
        "seconds": found.seconds,
        "seed": found.seed,
    }


def _way(way: WayOut, shell: PointShell, parts: list[int], excluded: list[int]) -> dict[str, Any]:
    def proof(swept: Swept) -> dict[str, Any]:
        return sweep_record(swept, shell, parts, excluded)

    return {
        "how": way.how,
        "poses": way.poses.tolist(),
        "length": way.length,
        "clearance": way.clearance,
        "rest_from": way.rest_from,
        "proof": proof(way.swept),
        "rest": way.rest and proof(way.rest),
        "depths": [depth_record(one) for one in way.depths],
        "beside": way.beside and proof(way.beside),
    }
