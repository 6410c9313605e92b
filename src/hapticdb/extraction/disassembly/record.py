"""The result of a search for an order for JSON: metres, displacements, world frame."""

from typing import Any

from hapticdb.extraction.disassembly.result import Disassembly, FailedSearch
from hapticdb.extraction.disassembly.verdict import disassembly_line
from hapticdb.extraction.record import extraction_record
from hapticdb.sweeps.record import named


def disassembly_record(found: Disassembly) -> dict[str, Any]:
    """Convert a result to numbers and strings, as `extract --disassemble --json` prints it.

    Each step is a record as `extract --json` prints it, with its proof, and the ids of what is not
    felt in it.
    """
    return {
        "verdict": found.verdict,
        "line": disassembly_line(found),
        "parts": [named(obj) for obj in found.parts],
        "steps": [
            {
                "excluded": list(step.excluded),
                **extraction_record(step.found, list(step.excluded)),
            }
            for step in found.steps
        ],
        "failed": [_failed(one) for one in found.failed],
        "is_out_of_time": found.is_out_of_time,
        "seconds": found.seconds,
        "seed": found.seed,
    }


def _failed(one: FailedSearch) -> dict[str, Any]:
    return {
        "parts": [named(obj) for obj in one.parts],
        "after_steps": one.n_gone,
        "verdict": one.verdict,
        "reason": one.reason or None,
        "blockers": [{**named(each.object), "pulls": each.pulls} for each in one.blockers],
    }
