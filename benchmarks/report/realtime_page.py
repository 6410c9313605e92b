"""What docs/realtime.md gives of results/realtime.json and results/edits.json, word for word."""

from collections.abc import Mapping, Sequence
from typing import Any

SESSION_HEAD = """\
| engine | asked, Hz | reached | late | computing | empty loop: reached | late |
| --- | --- | --- | --- | --- | --- | --- |"""
FRAME_HEAD = """\
| frames | points | dense bitmap in memory, us | flat loop over cells | with clusters |
| --- | --- | --- | --- | --- |"""


def session_table(results: Mapping[str, Any]) -> str:
    """Rates reached, and times in microseconds, p50 / p99 / p99.9, beside the empty loop's."""
    lines = [SESSION_HEAD]
    for one in results["sessions"]:
        loop, empty = one["loop"], one["empty"]
        columns = [
            one["engine"],
            f"{one['rate']:,.0f}",
            f"{loop['rate']:,.0f}",
            _times(loop["lateness"]),
            _times(loop["elapsed"]),
            f"{empty['rate']:,.0f}",
            _times(empty["lateness"]),
        ]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)


def _times(spread: Mapping[str, float]) -> str:
    return " / ".join(f"{1e6 * spread[share]:,.0f}" for share in ("p50", "p99", "p999"))


def frame_table(results: Mapping[str, Any]) -> str:
    """Microseconds of the dense bitmap, and the others' times as multiples of it."""
    rows = [
        f"| {one['part']} | {one['points']:,} | {one['us_per_frame']['dense']:,.1f} | "
        f"{one['ratio']['flat']:.2f} | {one['ratio']['clusters']:.2f} |"
        for one in results["frames"]
    ]
    return "\n".join([FRAME_HEAD, *rows])


def model_words(results: Mapping[str, Any]) -> str:
    """Size of the model and length of a session."""
    millions = results["object_voxels"] / 1e6
    return f"a car of {millions:.1f} million object voxels, {results['seconds']:.0f} s each"


def edit_words(results: Mapping[str, Any]) -> Sequence[str]:
    """How soon edits were felt, milliseconds: an item for each engine."""
    return [
        f"{one['engine']}: {one['edits']} moves of {one['voxels']:,} voxels were felt after "
        f"{one['felt_after_ms']['p50']:.1f} ms (median), {one['felt_after_ms']['p90']:.1f} ms "
        f"(90 %) and {one['felt_after_ms']['worst']:.1f} ms (worst)"
        for one in results["edits"]
    ]
