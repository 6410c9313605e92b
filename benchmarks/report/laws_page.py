"""What docs/realtime.md gives of results/both_laws.json, word for word."""

from collections.abc import Mapping
from typing import Any

from report.realtime_page import times

FRAME_HEAD = """\
| frame | points | plane, us | smooth, us | smooth / plane |
| --- | --- | --- | --- | --- |"""
SESSION_HEAD = """\
| environment | million voxels | law | asked, Hz | reached | late | computing | not known | N |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |"""

SHARES = ("p50", "p99")


def law_frame_table(results: Mapping[str, Any]) -> str:
    """Microseconds a frame under both laws, and their ratio."""
    rows = [
        f"| {one['frame']} | {one['points']:,} | {one['us_per_frame']['plane']:,.1f} | "
        f"{one['us_per_frame']['smooth']:,.1f} | {one['ratio']:.2f} |"
        for one in results["frames"]
    ]
    return "\n".join([FRAME_HEAD, *rows])


def law_session_table(results: Mapping[str, Any]) -> str:
    """Sessions under both laws: rates, times in microseconds, p50 / p99, and the largest force."""
    lines = [SESSION_HEAD]
    for one in results["sessions"]:
        loop = one["loop"]
        columns = [
            one["environment"],
            f"{one['object_voxels'] / 1e6:,.1f}",
            one["law"],
            f"{one['rate']:,.0f}",
            f"{loop['rate']:,.0f}",
            times(loop["lateness"], SHARES),
            times(loop["elapsed"], SHARES),
            f"{one['unknown_frames']:,}",
            f"{one['peak_force']:.2f}",
        ]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)
