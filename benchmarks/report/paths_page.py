"""What the pages give of the results of `make paths` and benchmarks/ways_out.py, word for word."""

from collections.abc import Mapping
from typing import Any

BATCH_SIDES = {
    "hapticdb, one thread": "hapticdb",
    "hapticdb, with force, one thread": "with force",
    "python-fcl": "python-fcl",
    "python-fcl, parts": "fcl, parts",
    "coal": "coal",
    "coal, parts": "coal, parts",
    "Open3D": "Open3D",
}
"""Sides of the table, if they were measured, and the heads of their columns."""
WAY_HEAD = """\
| part | answer | seconds | path, mm | proved from, mm | proved gap, mm | gap of the triangles, mm |
| --- | --- | ---: | ---: | ---: | ---: | ---: |"""
RATIO_HEAD = """\
| tool is | points | touch, one thread | all threads | how far, one thread | all threads |
| --- | ---: | ---: | ---: | ---: | ---: |"""
SHELL_HEAD = """\
| points | near | law | flat, us | sleeping, us | p99 | of the flat loop | budget, us | p99 |
| ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: |"""


def batch_table(results: Mapping[str, Any]) -> str:
    """Poses a second of processor time: does the tool touch, and how far is the nearest part.

    The force answers the first question alone.
    """
    rates: dict[tuple[int, str], dict[str, dict[str, float]]] = {}
    for cell in results["cells"]:
        row = rates.setdefault((cell["points"], cell["situation"]), {})
        row[cell["question"]] = {
            side: one["poses_per_processor_s"] for side, one in cell["sides"].items()
        }
    measured = [side for side in BATCH_SIDES if any(side in row["touch"] for row in rates.values())]
    heads = ["tool is", "points", *(BATCH_SIDES[side] for side in measured)]
    lines = [f"| {' | '.join(heads)} |", f"| ---{' | ---:' * (len(heads) - 1)} |"]
    for (points, situation), row in rates.items():
        sides = [
            ", ".join(f"{row[question][side]:,.0f}" for question in row if side in row[question])
            for side in measured
        ]
        lines.append(f"| {' | '.join([situation, f'{points:,}', *sides])} |")
    return "\n".join(lines)


def batch_ratio_table(results: Mapping[str, Any]) -> str:
    """How many times as many poses a second as the fastest of the others, of wall time."""
    lines = [RATIO_HEAD]
    rows: dict[tuple[str, int], list[str]] = {}
    for cell in results["cells"]:
        ratios = (cell["times_best_peer_one_thread"], cell["times_best_peer"])
        row = rows.setdefault((cell["situation"], cell["points"]), [])
        row += [f"{ratio:.{0 if ratio >= 9.95 else 1}f}" for ratio in ratios]
    for (situation, points), row in rows.items():
        lines.append(f"| {' | '.join([situation, f'{points:,}', *row])} |")
    return "\n".join(lines)


def batch_words(results: Mapping[str, Any]) -> list[str]:
    """The scene and the tool."""
    scene = results["scene"]
    return [
        f"{scene['parts']} parts, {scene['triangles']:,} triangles",
        f"{scene['tool_triangles']:,} triangles",
    ]


def shell_table(results: Mapping[str, Any]) -> str:
    """Medians of the loops and p99 of the sleeping ones, without and with a budget, us."""
    lines = [SHELL_HEAD]
    for one in results["lines"]:
        times = one["us"]
        near = 100 * one["near_share"]
        columns = [
            f"{one['points']:,}",
            f"{near:.1f} %" if near < 10 else f"{near:.0f} %",
            one["law"],
            f"{times['flat']['p50']:,.0f}",
            f"{times['sleeping']['p50']:,.0f}",
            f"{times['sleeping']['p99']:,.0f}",
            f"{one['ratio']['sleeping']:.2f}",
        ]
        if "budget" in times:
            columns += [f"{times['budget']['p50']:,.0f}", f"{times['budget']['p99']:,.0f}"]
        else:
            columns += ["-", "-"]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)


def shell_words(results: Mapping[str, Any]) -> list[str]:
    """Sizes of the sheet, as the results have them."""
    assert {one["points"] for one in results["lines"]} == {99_856, 1_000_000}
    budgets = [one["budget"] for one in results["lines"] if "budget" in one["us"]]
    (points,) = {one["points"] for one in budgets}
    most_off = 100.0 * max(one["most_off"] for one in budgets)
    return ["`make paths`", "500 frames", f"{points:,} points", f"{most_off:.1f} %"]


def way_table(results: Mapping[str, Any]) -> str:
    """Answer, seconds and lengths of each question; what blocks first where no way was found."""
    lines = [WAY_HEAD]
    for one in results["rows"]:
        answer, lengths = one["verdict"], ["-"] * 4
        if "length_m" in one:
            keys = ["length_m", "proved_from_m", "clearance_m", "mesh_distance_m"]
            lengths = [f"{1e3 * one[key]:,.{0 if key == 'length_m' else 2}f}" for key in keys]
        elif one["blockers"]:
            answer += f", {_name(one['blockers'][0][0])} named first"
        columns = [one["parts"], answer, f"{one['s']:.1f}", *lengths]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)


def _name(path: str) -> str:
    """The last part of an object's name, which stands well in a table."""
    return " ".join(path.rpartition("|")[2].split())
