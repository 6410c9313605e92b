"""The tables of the pages, made from results/.

    python benchmarks/page_tables.py        # fill the tables of all pages anew

A page is written by hand. Below each line ``<!-- table: NAME -->`` stands a table, or a list, made
from results; it is replaced, up to the next empty line.
"""

import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import records

Result = Mapping[str, Any]
Results = Mapping[str, Result]
ROOT = Path(__file__).parent.parent
MARK = re.compile(r"(<!-- table: ([\w-]+) -->\n)((?:.+\n)*)")
NONE = "-"
"""Stands where nothing was measured."""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown table; columns of numbers are aligned to the right."""
    body = [[" ".join(text.split()).replace("|", "\\|") for text in row] for row in rows]
    columns = list(zip(*body, strict=True)) or [()] * len(head)
    rules = [
        "---:" if all(text == NONE or text[:1].isdigit() for text in column) else "---"
        for column in columns
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in [list(head), rules, *body])


def us_text(value: float | None) -> str:
    """A number, mostly microseconds, to two or three digits; a dash where none was measured."""
    if value is None:
        return NONE
    if value >= 99.5:
        return f"{value:,.0f}"
    return f"{value:.1f}" if value >= 9.95 else f"{value:.2g}"


def facts(found: Result, *inputs: str) -> str:
    """Commit, machine, versions and inputs of a result, or some of the inputs, a line each."""
    lines = [f"- commit: {found['commit']}"]
    for part in ("machine", "versions"):
        said = ", ".join(f"{key} {value}" for key, value in found[part].items())
        lines.append(f"- {part}: {said}")
    about = found["inputs"]
    return "\n".join([*lines, *(f"- {key}: {about[key]}" for key in inputs or about)])


def _times(spread: Mapping[str, float]) -> str:
    """Median and 99th percentile of times, microseconds."""
    return " / ".join(f"{1e6 * spread[share]:,.0f}" for share in ("p50", "p99"))


def listed(cells: Sequence[Result], columns: Mapping[str, Callable[[Result], str]]) -> str:
    """Table with a row a cell; the columns by their heads."""
    return table(list(columns), [[text(one) for text in columns.values()] for one in cells])


def sessions(results: Results) -> str:
    """Rates, and times in microseconds, beside those of an empty loop."""
    return listed(
        results["realtime"]["sessions"],
        {
            "engine": lambda one: one["engine"],
            "set, Hz": lambda one: f"{one['rate']:,.0f}",
            "reached": lambda one: f"{one['loop']['rate']:,.0f}",
            "late": lambda one: _times(one["loop"]["lateness"]),
            "computing": lambda one: _times(one["loop"]["elapsed"]),
            "empty loop: reached": lambda one: f"{one['empty']['rate']:,.0f}",
            "empty loop: late": lambda one: _times(one["empty"]["lateness"]),
        },
    )


def frames(results: Results) -> str:
    """Microseconds of the dense bitmap, and the others' times as multiples of it."""
    heads = {"flat": "cells, flat loop", "session": "as a session", "distance": "law distance"}
    return listed(
        results["realtime"]["frames"],
        {
            "points": lambda one: f"{one['points']:,}",
            "hits": lambda one: f"{one['hits']:,.0f}",
            "dense bitmap in memory, us": lambda one: us_text(one["us_per_frame"]["dense"]),
            **{
                head: lambda one, name=name: f"{one['ratio'][name]:.2f}"  # type: ignore[misc]
                for name, head in heads.items()
            },
        },
    )


def edits(results: Results) -> str:
    """Milliseconds from the commit of an edit to the first frame with it."""
    rows = []
    for one in results["realtime"]["edits"]:
        after = (f"{ms:.1f}" for ms in one["latency_ms"].values())
        rows.append([one["engine"], f"{one['edits']}", f"{one['voxels']:,}", *after])
    head = ["engine", "moves", "voxels", "median, ms", "90 % within, ms", "worst, ms"]
    return table(head, rows)


def far_away(results: Results) -> str:
    """Sessions whose database answers after a delay."""
    return listed(
        results["far_away"]["cells"],
        {
            "hand, m/s": lambda one: f"{one['speed']:g}",
            "round trip, ms": lambda one: f"{1e3 * one['round_trip']:g}",
            "reached, Hz": lambda one: f"{one['loop']['rate']:,.0f}",
            "late p99, us": lambda one: f"{1e6 * one['loop']['lateness']['p99']:,.0f}",
            "frames with unknown cells, %": lambda one: (
                f"{100 * one['unknown_frames'] / one['loop']['frames']:.2g}"
            ),
            "cells fetched": lambda one: f"{one['cache']['loaded']:,}",
            "a fetch, ms": lambda one: us_text(1e3 * one["cache"]["latency"]),
        },
    )


def gpu_frames(results: Results) -> str:
    """Times of a frame on a GPU, pose in and wrench out, and on one processor."""
    rows = []
    for one in results["gpu"]["frames"]:
        times = (f"{one['gpu'][share]:.2f}" for share in ("p50_ms", "p99_ms"))
        rows.append([f"{one['points']:,}", *times, us_text(one["one_processor"]["p50_ms"])])
    return table(["points", "p50, ms", "p99, ms", "one processor, p50, ms"], rows)


def gpu_hands(results: Results) -> str:
    """Sessions with proximity queries on a GPU, beside those on a processor."""
    rows = []
    for one in results["gpu"]["hands"]:
        gpu, processor = one["gpu"], one["processor"]
        times = [us_text(gpu[share]) for share in ("p50_ms", "p99_ms")]
        reached = [us_text(side["reached_hz"]) for side in (gpu, processor)]
        rows.append([f"{one['points']:,}", *times, *reached])
    return table(["points", "p50, ms", "p99, ms", "Hz", "Hz on a processor"], rows)


def gpu_batches(results: Results) -> str:
    """Millions of poses a second on a GPU, beside all processors, and Warp's mesh queries."""
    columns = ("touch", "processors", "clearance_gpu", "clearance_processors")
    warp = results["gpu"]["warp"]
    rows = []
    for one in results["gpu"]["batches"]:
        rates = [one[f"{name}_poses_per_s"] for name in columns]
        for at, reach in ((2, "2.5"), (5, "32")):
            rates.insert(at, warp[f"{one['situation']}_within_{reach}_voxels_poses_per_s"])
        rows.append([one["situation"], *(us_text(1e-6 * rate) for rate in rates)])
    head = ["tool is", "touch", "processors", "Warp within 2.5 voxels"]
    return table([*head, "how far", "processors", "Warp within 32 voxels"], rows)


def removal_paths(results: Results) -> str:
    """Answer and lengths of each question; without a path, the first blocking object."""
    rows = []
    for one in results["removal_paths"]["rows"]:
        answer, lengths = one["verdict"], [NONE] * 3
        if "length_m" in one:
            keys = ["length_m", "gap_m", "mesh_distance_m"]
            lengths = [f"{1e3 * one[key]:,.{0 if key == 'length_m' else 2}f}" for key in keys]
        elif one["blockers"]:
            answer += f", {one['blockers'][0][0]} named first"
        rows.append([one["parts"], answer, *lengths])
    return table(["part", "answer", "path, mm", "proved gap, mm", "coal's gap, mm"], rows)


def fits(results: Results) -> str:
    """Gaps of pegs in their holes, and what a hand beside the axis feels."""

    def lengths(*values: float | None) -> str:
        return " to ".join(NONE if value is None else f"{1e3 * value:.4f}" for value in values)

    rows = []
    for one in results["fits"]["rows"]:
        gaps = lengths(one["nominal_m"]), lengths(one["gap_m"], one["gap_at_most_m"])
        aside = math.hypot(*one["force_aside_n"])
        felt = f"{one['force_on_axis_n']:.2f}", f"{aside:.2f}"
        rows.append([one["fit"], one["verdict"], *gaps, f"{one['cpu_s']:.2f}", *felt])
    head = ["peg", "verdict", "nominal gap, mm", "proved gap, mm", "processor time, s"]
    return table([*head, "on the axis, N", "beside it, N"], rows)


def truth(results: Results) -> str:
    """Answers beside oracles; gaps below theirs in um."""
    head = ("what, by what", "clear", "false", "hit", "false", "undecided", "gap below, um")
    names = ("said_clear", "wrong_clear", "said_hit", "wrong_hit", "undecided")
    rows = []
    for row in results["truth"]["rows"]:
        told, below = [f"{row[name]:,}" for name in names], row["gap_below_m"]
        took = f", {us_text(row['s'])} s" * ("CCD" in row["what"])
        what = f"{row['what']}: {row['oracle']}{took}"
        rows.append([what, *told, us_text(below and 1e6 * below)])
    return table(head, rows)


def scale_ahead(results: Results) -> str:
    """What more voxels take, by the rates of the largest environment of each engine."""
    stored = [one for one in results["scale"]["cells"] if "poses" not in one]
    largest = {one["engine"]: one for one in stored}  # sizes ascend
    rows = []
    for engine, one in largest.items():
        rate = one["object_voxels"] / one["import_s"]
        sizes = [
            text
            for n in (1e10, 1e12)
            for text in (f"{n * one['bytes_per_voxel'] / 1e9:,.0f}", f"{n / rate / 3600:.1f}")
        ]
        rows.append([engine, f"{one['bytes_per_voxel']:.2f}", f"{rate / 1e6:.1f}", *sizes])
    head = ["engine", "bytes a voxel", "million voxels written a second"]
    ahead = ["10^10 voxels, GB", "hours", "10^12 voxels, GB", "hours"]
    return table([*head, *ahead], rows)


def tables() -> dict[str, Callable[[Results], str]]:
    """Every table by its name."""
    from feel.measures import table_of, walls_of  # noqa: PLC0415 - both use this module
    from paper.tables import EVALUATION  # noqa: PLC0415

    return {
        "sessions": sessions,
        "frames": frames,
        "edits": edits,
        "far-away": far_away,
        "gpu-frames": gpu_frames,
        "gpu-hands": gpu_hands,
        "gpu-batches": gpu_batches,
        "ways-out": removal_paths,
        "fits": fits,
        "truth": truth,
        "scale-ahead": scale_ahead,
        "feel": lambda results: table_of(results["feel"]["cells"]),
        "walls": lambda results: walls_of(results["feel"]["cells"]),
        "feel-conditions": lambda results: facts(results["feel"]),
        **EVALUATION,
    }


def filled(text: str, results: Results) -> str:
    """The text of a page with its tables made anew; a table whose results are missing is left."""
    made, measured = tables(), _Measured(results)

    def anew(mark: re.Match[str]) -> str:
        try:
            return f"{mark[1]}{made[mark[2]](measured)}\n"
        except NotMeasuredError:
            return mark[0]

    return MARK.sub(anew, text)


class NotMeasuredError(Exception):
    """An experiment is missing."""


class _Measured(dict[str, Result]):
    def __missing__(self, name: str) -> Result:
        raise NotMeasuredError(name)


def refill(page: str, folder: Path, out: Path | None = None) -> None:
    """Fill a page's tables from the results in a folder; `out` is another file for the page."""
    path = ROOT / page
    text = filled(path.read_text(), records.read(folder))
    if out is not None:
        text = text.replace("../results/", f"{os.path.relpath(folder, out.parent)}/")
    (out or path).write_text(text)


def publish(name: str, cells: Sequence[Result], inputs: Result) -> None:
    """Write a result, with the machine's load at the end, and fill the evaluation's tables."""
    load = ", ".join(f"{load:.1f}" for load in os.getloadavg())
    found = records.result(name, cells, {**inputs, "load": f"{load} at the end"})
    records.write(ROOT / "results", {name: found})
    refill("docs/evaluation.md", ROOT / "results")


if __name__ == "__main__":
    for found in sorted((ROOT / "docs").glob("*.md")):
        if MARK.search(found.read_text()):
            refill(f"docs/{found.name}", ROOT / "results")
