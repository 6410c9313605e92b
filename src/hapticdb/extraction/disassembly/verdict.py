"""The result of a search for an order in words."""

from hapticdb.extraction.disassembly.result import Disassembly, FailedSearch
from hapticdb.extraction.verdict import extraction_line
from hapticdb.store.base import Object
from hapticdb.sweeps.verdict import names_of


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


def step_line(found: Disassembly, number: int) -> str:
    """Say in one line what comes out in a step, and what is proved; number : 0 for the first."""
    step = found.steps[number].found
    return f"{names_of(step.parts)}: {extraction_line(step)}"


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
