"""What docs/serving.md gives of results/floods.json, word for word."""

from collections.abc import Mapping
from typing import Any


def flood_table(results: Mapping[str, Any]) -> str:
    """Lateness in microseconds, frames in time, memory, of each line."""
    rows = [
        "| flood | messages | late p50 / p99 / most, us | in time, % | unknown | memory, MB |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for one in results["lines"]:
        late = " / ".join(f"{1e6 * value:,.0f}" for value in one["lateness"].values())
        memory = f"{one['memory_before_mb']:.0f} -> {one['memory_after_mb']:.0f}"
        rows.append(
            f"| {one['kind']} | {one.get('sent', 0):,} | {late} | {100 * one['in_time']:.1f} | "
            f"{one['unknown_frames']:,} | {memory} |"
        )
    return "\n".join(rows)
