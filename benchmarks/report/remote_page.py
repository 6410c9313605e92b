"""What the pages give of results/remote_cells.json, word for word."""

from collections.abc import Mapping
from typing import Any

HEAD = """\
| added, ms | echo, ms | question | edit felt | age | in time, % | unknown | held | error, mN |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |"""


def remote_table(results: Mapping[str, Any]) -> str:
    """Round trips (p50 / p99), from a commit to its frame (p50 / worst), age of what is known
    (p50 / p99), frames in time, frames with unknown cells and with a held force, and the error of
    the force against the engine on the spot (RMS / greatest).
    """
    lines = [HEAD]
    for one in results["lines"]:
        error = one["error"]
        columns = [
            "on the spot" if one["added"] is None else f"{1e3 * one['added']:.0f}",
            _both(one["echo"], "p50", "p99"),
            _both(one["question"], "p50", "p99"),
            _both(one["felt_after"], "p50", "worst"),
            _both(one["age"], "p50", "p99"),
            f"{100 * one['in_time']:.1f}",
            f"{one['unknown_frames']:,}",
            f"{one['held_frames']:,}",
            f"{1e3 * error['rms']:.3f} / {1e3 * error['worst']:.3f}",
        ]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)


def _both(times: Mapping[str, float] | None, middle: str, far: str) -> str:
    """Two percentiles in milliseconds."""
    if times is None:
        return "-"
    return f"{1e3 * times[middle]:.1f} / {1e3 * times[far]:.1f}"
