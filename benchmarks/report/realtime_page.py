"""What docs/realtime.md gives of results/realtime.json and results/edits.json, word for word."""

from collections.abc import Mapping, Sequence
from typing import Any

SESSION_HEAD = """\
| engine | asked, Hz | reached | late | computing | empty loop: reached | late |
| --- | --- | --- | --- | --- | --- | --- |"""
FRAME_HEAD = """\
| frames | points | dense bitmap in memory, us | flat loop over cells | with clusters |
| --- | --- | --- | --- | --- |"""

EDIT_HEAD = """\
| engine | moves | voxels | median, ms | 90 % within, ms | worst, ms |
| --- | --- | --- | --- | --- | --- |"""


def session_table(results: Mapping[str, Any]) -> str:
    """Rates reached, and times in microseconds, p50 / p99 / p99.9, beside the empty loop's."""
    lines = [SESSION_HEAD]
    for one in results["sessions"]:
        loop, empty = one["loop"], one["empty"]
        columns = [
            one["engine"],
            f"{one['rate']:,.0f}",
            f"{loop['rate']:,.0f}",
            times(loop["lateness"]),
            times(loop["elapsed"]),
            f"{empty['rate']:,.0f}",
            times(empty["lateness"]),
        ]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)


def times(spread: Mapping[str, float], shares: Sequence[str] = ("p50", "p99", "p999")) -> str:
    """Percentiles of times, microseconds, in one cell of a table."""
    return " / ".join(f"{1e6 * spread[share]:,.0f}" for share in shares)


def frame_table(results: Mapping[str, Any]) -> str:
    """Microseconds of the dense bitmap, and the others' times as multiples of it."""
    rows = [
        f"| {one['part']} | {one['points']:,} | {one['us_per_frame']['dense']:,.1f} | "
        f"{one['ratio']['flat']:.2f} | {one['ratio']['clusters']:.2f} |"
        for one in results["frames"]
    ]
    return "\n".join([FRAME_HEAD, *rows])


def edit_table(results: Mapping[str, Any]) -> str:
    """Milliseconds from the commit of an edit to the first frame that felt it."""
    rows = [
        f"| {one['engine']} | {one['edits']} | {one['voxels']:,} | "
        f"{' | '.join(f'{ms:.1f}' for ms in one['felt_after_ms'].values())} |"
        for one in results["edits"]
    ]
    return "\n".join([EDIT_HEAD, *rows])


def model_words(results: Mapping[str, Any]) -> Sequence[str]:
    """Size of the model, points of the tool and length of a session."""
    millions = results["object_voxels"] / 1e6
    (points,) = {one["conditions"]["points"] for one in results["sessions"]}
    return (
        f"a car of {millions:.1f} million object voxels",
        f"{points} points sliding",
        f"{results['seconds']:.0f} s each",
    )
