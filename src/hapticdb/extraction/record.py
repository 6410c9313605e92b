"""Results of searches for JSON: metres, displacements, world frame."""

from typing import Any

from hapticdb.extraction.disassembly.result import Disassembly
from hapticdb.extraction.result import Extraction, WayOut
from hapticdb.extraction.verdict import disassembly_line, extraction_line
from hapticdb.pointshell.shell import PointShell
from hapticdb.sweeps.record import plain, sweep_record


def extraction_record(found: Extraction, excluded: list[int]) -> dict[str, Any]:
    """Convert a result to numbers and strings, as `hapticdb extract --json` prints it.

    excluded : ids of the objects that were left out, those of the parts among them.
    """
    parts = [obj.id for obj in found.parts]
    told = ("to", "near", "blockers", "pulls", "motions", "poses", "is_planned", "seconds", "seed")
    return {
        "verdict": found.verdict,
        "line": extraction_line(found),
        "parts": plain(found.parts),
        "way": found.way and _way(found.way, found.shell, parts, excluded),
        **{name: plain(getattr(found, name)) for name in told},
    }


def _way(way: WayOut, shell: PointShell, parts: list[int], excluded: list[int]) -> dict[str, Any]:
    told = ("how", "poses", "length", "gap")
    return {name: plain(getattr(way, name)) for name in told} | {
        "proof": sweep_record(way.swept, shell, parts, excluded)
    }


def disassembly_record(found: Disassembly) -> dict[str, Any]:
    """Convert a result to numbers and strings, as `extract --disassemble --json` prints it.

    Each step is a record as `extract --json` prints it, with its proof, and the ids of what is not
    felt in it.
    """
    return {
        "verdict": found.verdict,
        "line": disassembly_line(found),
        "parts": plain(found.parts),
        "steps": [
            {"excluded": plain(step.excluded)} | extraction_record(step.found, list(step.excluded))
            for step in found.steps
        ],
        "failed": [
            {
                "parts": plain(one.parts),
                "after_steps": one.n_gone,
                "verdict": one.verdict,
                "reason": one.reason or None,
                "blockers": plain(one.blockers),
            }
            for one in found.failed
        ],
        "is_out_of_time": found.is_out_of_time,
        "seconds": found.seconds,
        "seed": found.seed,
    }
