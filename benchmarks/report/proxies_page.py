"""What docs/protocol.md gives of results/contact_proxies.json, word for word."""

from collections.abc import Mapping
from typing import Any

HEAD = """\
| path | added, ms | echo, ms | round trip, ms | age, ms | RMS error, N | largest, N | bytes |
| --- | --- | --- | --- | --- | --- | --- | --- |"""


def proxy_table(results: Mapping[str, Any]) -> str:
    """Round trips (median), ages (p50 / p99) and errors, with their shares of the force."""
    echoes = {one["added"]: one["p50"] for one in results["echo"]}
    lines = [HEAD]
    for one in results["lines"]:
        error, force, age = one["error"], one["force"], one["age"]
        columns = [
            one["path"],
            f"{1e3 * one['added']:.0f}",
            f"{1e3 * echoes[one['added']]:.1f}",
            f"{1e3 * one['round_trip']:.1f}",
            f"{1e3 * age['p50']:.0f} / {1e3 * age['p99']:.0f}",
            f"{error['rms']:.2f} ({100 * error['rms'] / force['rms']:.1f} %)",
            f"{error['max']:.2f} ({100 * error['max'] / force['max']:.0f} %)",
            f"{one['bytes']:.0f}",
        ]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)
