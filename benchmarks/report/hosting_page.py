"""What docs/realtime.md gives of results/many_sessions.json, word for word."""

from collections.abc import Mapping
from typing import Any

from report.realtime_page import times

HEAD = """\
| sessions | processes | Hz | in time, % | least, % | late, us | computing, us | MB each |
| --- | --- | --- | --- | --- | --- | --- | --- |"""
SHARES = ("p50", "p99")


def hosted_table(results: Mapping[str, Any]) -> str:
    """Rates, shares of frames in time, times in microseconds (p50 / p99), memory a session."""
    lines = [HEAD]
    for one in results["lines"]:
        columns = [
            f"{one['sessions']} {one['kind']}",
            f"{one['workers']}",
            f"{one['rate']:,.0f}",
            f"{100 * one['in_time']:.1f}",
            f"{max(100 * one['least_in_time'], 0.0):.1f}",
            times(one["lateness"], SHARES),
            times(one["elapsed"], SHARES),
            f"{one['worker_mb'] / one['sessions']:,.1f}",
        ]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)
