"""The tables of docs/evaluation.md, made from measured cells."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from page_tables import NONE, facts, listed, table, us_text
from paper.cells import (
    Cell,
    Results,
    by_strategy,
    distinct,
    grouped,
    named,
    typical,
)

COMPARED = ("points", "statement", "array", "maxgap", "cbgroup")
"""Strategies of the claim, in the order of its columns."""
SHOWN = (1, 32)
"""Numbers of readers in the table; the plot has all."""
PULLED = {0: "come out", 4: "leave an overlap", 1: "are blocked", 3: "not decided"}
"""Answers of `extract` by straight pulls, by its exit codes."""
CLOSE = 1.05
"""CBGroup counts as good as the best MAXGAP up to this ratio of their times."""


def cells_of(results: Results, name: str) -> Sequence[Cell]:
    """Cells of an experiment."""
    cells: Sequence[Cell] = results[name]["cells"]
    return cells


def rate_text(cell: Cell | None) -> str:
    """Frames a second at the typical time, with a star where the time limit ended it."""
    if cell is None:
        return NONE
    return f"{1e6 / typical(cell):,.0f}" + "*" * bool(cell.get("cut_short"))


def time_text(cell: Cell | None) -> str:
    """Typical time of a cell, with a star where the time limit ended it."""
    return NONE if cell is None else us_text(typical(cell)) + "*" * bool(cell.get("cut_short"))


def claim(results: Results) -> str:
    """Frames a second of every strategy at random poses; the best beside the bitmap in memory."""
    cells = [cell for cell in cells_of(results, "claim") if cell["poses"] == "random"]
    cells = [cell for cell in cells if (cell["law"], cell["file"]) != ("distance", "cold")]
    (bitmap,) = [cell for cell in cells if cell["strategy"] == "bitmap"]
    rows = []
    older = distinct(cells, "engine")[2:-1]  # after memory and SQLite
    for group in grouped(cells, ("engine", "layout", "law", "file")).values():
        by, one = by_strategy(group), group[0]
        if "bitmap" not in by and one["engine"] not in older:
            place = f"{one['engine']}, {named(one['layout'])}, {one['law']}"
            rates = [rate_text(by.get(strategy)) for strategy in COMPARED]
            best = min(map(typical, by.values())) / typical(bitmap)
            rows.append([place + ", cold" * (one["file"] == "cold"), *rates, us_text(best)])
    return table(["random poses", *map(named, COMPARED), "best / bitmap"], rows)


def summary(results: Results) -> str:
    """The claim: microseconds of a frame under each law over all scenes and poses."""
    lines = []
    for (engine, law), group in grouped(cells_of(results, "visits"), ("engine", "law")).items():
        us: dict[str, list[float]] = {}
        for own in grouped(group, ("environment", "poses")).values():
            times = {cell.get("visit", cell["strategy"]): typical(cell) for cell in own}
            for name, value in (*times.items(), ("ratio", times["again"] / times["bitmap"])):
                us.setdefault(name, []).append(value)
        said = {name: f"{us_text(min(all_))} to {us_text(max(all_))}" for name, all_ in us.items()}
        lines.append(
            f"- {engine}, law {law}: {said['first']} us at the first visit, {said['again']} from "
            f"then on, {said['ratio']} times the bitmap; by 300 statements {said['points']}."
        )
    return "\n".join(lines)


def visits(results: Results) -> str:
    """Microseconds of a frame's first visit and of the next ones; the bitmap in memory."""
    rows = []
    cells = cells_of(results, "visits")
    engines = distinct(cells, "engine")
    for (where, poses, law), group in grouped(cells, ("environment", "poses", "law")).items():
        us = {(c["engine"], c.get("visit", c["strategy"])): us_text(typical(c)) for c in group}
        row = [f"{where}, {poses}, {law}", us[engines[0], "bitmap"]]
        row += [us[engine, one] for engine in engines for one in ("points", "first", "again")]
        rows.append(row)
    beside = [f"{one}: points" for one in engines]
    head = [text for name in beside for text in (name, "first", "again")]
    return table(["us a frame", "bitmap", *head], rows)


def table_1(results: Results) -> str:
    """Objects, triangles and voxels."""
    return listed(
        cells_of(results, "costs"),
        {
            "environment": lambda cell: cell["environment"],
            "objects": lambda cell: f"{cell['objects']:,}",
            "triangles": lambda cell: f"{cell['triangles']:,}",
            "object voxels": lambda cell: f"{cell['object_voxels']:,}",
        },
    )


def costs(results: Results) -> str:
    """What an import takes, without and with distances."""
    rows = []
    for cell in cells_of(results, "costs"):
        voxels, row = cell["object_voxels"], [cell["environment"]]
        for one in (cell["plain"], cell["distance"]):
            row += [f"{one['bytes'] / voxels:.2f}", us_text(one["s"])]
            row += [us_text(1e6 * one["s"] / voxels), f"{one['peak_mb']:,.0f}"]
        rows.append(row)
    head = ["bytes a voxel", "s", "s a million voxels", "peak, MB"]
    return table(["", *head, *(f"with distances: {head[0]}", *head[1:])], rows)


def waits(results: Results) -> str:
    """Seconds of each verb, first and again; memory of the latter."""
    return listed(
        [cell for cell in cells_of(results, "waits") if cell["side"] == "this"],
        {
            "verb": lambda cell: f"`{cell['command'].split()[0]}`",
            "first, s": lambda cell: us_text(cell["first"]["s"]),
            "again, s": lambda cell: us_text(cell["again"]["s"]),
            "MB": lambda cell: f"{cell['again']['peak_mb']:,.0f}",
        },
    )


def pulls(results: Results) -> str:
    """Answers and seconds of pulls."""
    cells = cells_of(results, "pulls")
    codes, s = [cell["code"] for cell in cells], [cell["s"] for cell in cells]
    said = ", ".join(f"{codes.count(code)} {answer}" for code, answer in PULLED.items())
    return f"- {said}; median {np.median(s):.1f} s, worst {max(s):.1f} s."


def clash_seconds(results: Results) -> str:
    """Processor time and memory of every search."""
    return listed(
        cells_of(results, "clashes"),
        {
            "scene": lambda cell: f"{cell['scene']}, {cell['search']}",
            "pairs": lambda cell: f"{cell['pairs']:,}",
            "processor, s": lambda cell: us_text(cell["cpu_s"]),
            "MB": lambda cell: us_text(cell["peak_mb"]),
        },
    )


def hands(results: Results) -> str:
    """Lateness and computing time of periods, us."""
    cells = [cell for cell in cells_of(results, "periods") if cell["side"] == "this"]
    rows = [[f"{c['hands']}", f"{c['rate']:,.0f}", *map(us_text, c["us"].values())] for c in cells]
    return table(["hands", "Hz", *cells[0]["us"]], rows)


def grouping(results: Results) -> str:
    """Time of CBGroup alone by the number of keys, as fitted."""
    said = []
    for (layout,), group in grouped(cells_of(results, "grouping"), ("layout",)).items():
        a, b = fitted(group)
        said.append(f"{a:.1f} us + {1e3 * b:.1f} ns n for the keys of {named(layout)}")
    n = max(cell["keys"] for cell in cells_of(results, "grouping"))
    return f"- {', '.join(said)}, measured up to n = {n:,}."


def fitted(cells: Sequence[Cell]) -> tuple[float, float]:
    """Fit t = a + b n by least squares of relative errors: a and b in us, n keys."""
    n, t = (np.array([cell[key] for cell in cells], float) for key in ("keys", "grouping_us"))
    a, b = np.linalg.lstsq(np.column_stack([1.0 / t, n / t]), np.ones(len(t)), rcond=None)[0]
    return float(a), float(b)


def many(results: Results) -> str:
    """Readers alone, and beside writers."""
    rows = []
    cells = [cell for cell in cells_of(results, "many") if cell["readers"] in SHOWN]
    for (engine, readers), group in grouped(cells, ("engine", "readers")).items():
        alone, beside = sorted(group, key=lambda cell: float(cell["writers"]))
        figures = [f"{alone['frames_per_s']:,.0f}", us_text(alone.get("frame_p99_ms"))]
        figures += [f"{beside['frames_per_s']:,.0f}"]
        figures += [us_text(beside.get(f"{name}_p99_ms")) for name in ("frame", "stale", "edit")]
        rows.append([engine, f"{readers}", *figures, f"{beside['refused']}"])
    head = ["engine", "readers", "frames/s", "p99", "with writers", "p99", "stale p99", "edit p99"]
    return table([*head, "refused"], rows)


# --- Figures 9 and 10 -----------------------------------------------------------------------------


class Contest(NamedTuple):
    """MaxGap's fastest cell and CBGroup's under the same conditions; the fastest of `array`."""

    best: Cell
    cbgroup: Cell
    array: Cell

    @property
    def ratio(self) -> float:
        """CBGroup's time as a multiple of the best MAXGAP's."""
        return typical(self.cbgroup) / typical(self.best)


def contests(cells: Sequence[Cell]) -> list[Contest]:
    """A contest for each set of conditions."""
    groups = [by_strategy(group) for group in grouped(cells).values()]
    return [Contest(by["maxgap"], by["cbgroup"], by["array"]) for by in groups]


def figure_9(results: Results) -> str:
    """CBGroup and `array` beside the best MAXGAP."""
    found = contests(cells_of(results, "figure9"))
    ratios, best = [one.ratio for one in found], [one.best["maxgap"] for one in found]
    soonest = sum(typical(one.array) < min(map(typical, one[:2])) for one in found)
    return (
        f"- CBGroup takes {min(ratios):.2f} to {max(ratios):.2f} times as long as the best MAXGAP, "
        f"which is {min(best):,} to {max(best):,}; `array` is faster than both in {soonest} of "
        f"{len(found)} cases."
    )


def figure_10(results: Results) -> str:
    """In how many contests CBGroup is as good as the best MAXGAP."""
    found = contests(cells_of(results, "figure10"))
    close = sum(one.ratio <= CLOSE for one in found)
    best = [one.best["maxgap"] for one in found]
    return (
        f"- CBGroup is within 5 % of the best MAXGAP, or better, in {close} of {len(found)} "
        f"cases, at worst {max(one.ratio for one in found):.2f} times. The best MAXGAP is "
        f"{min(best):,} to {max(best):,}."
    )


def growth(results: Results) -> str:
    """Microseconds a frame, bytes a voxel and seconds by the number of object voxels."""
    cells = cells_of(results, "scale")
    sizes = distinct(cells, "object_voxels")
    rows = []
    timed = [c for c in cells if (c.get("strategy"), c.get("poses")) == ("array", "random")]
    for (engine,), group in grouped(timed, ("engine",)).items():
        by = {cell["object_voxels"]: time_text(cell) for cell in group}
        rows.append([f"{engine}, us", *(by.get(n, NONE) for n in sizes)])
    for key, words in (("bytes_per_voxel", "bytes a voxel"), ("import_s", "written in, s")):
        for (engine,), group in grouped(cells, ("engine",)).items():
            by = {cell["object_voxels"]: us_text(cell[key]) for cell in group}
            rows.append([f"{engine}, {words}", *(by[n] for n in sizes)])
    return table(["", *(f"{n:,}" for n in sizes)], rows)


def scale_growth(results: Results) -> str:
    """The largest environment's time over that of one car, for each kind of poses."""
    whole = [c for c in cells_of(results, "scale") if "us" in c and c["copies"] >= 1]
    lines = []
    for (poses,), group in grouped(whole, ("poses",)).items():
        growths = []
        for own in grouped(group, ("engine", "strategy")).values():
            own.sort(key=lambda cell: float(cell["object_voxels"]))
            growths.append(typical(own[-1]) / typical(own[0]))
        most = max(cell["copies"] for cell in group)
        said = f"{min(growths):.2f} to {max(growths):.2f}"
        lines.append(f"- {poses} poses: {most:,} times the voxels take {said} times the time.")
    return "\n".join(lines)


def speed(results: Results) -> str:
    """Nanoseconds a point, one thread of hapticdb beside the fastest of the others."""
    rows: dict[tuple[str, str], list[str]] = {}
    for cell in results["batches"]["cells"]:
        if cell["points"] == 10_000:  # between the others
            continue
        ns = {
            name: 1e9 / side["poses_per_s"] / cell["points"] for name, side in cell["sides"].items()
        }
        own = [f"hapticdb, {how}" for how in ("one thread", "with force, one thread")]
        own += ["hapticdb, dense bitmap"] * (cell["question"] == "touch")
        best = min((name for name in ns if not name.startswith("hapticdb")), key=ns.__getitem__)
        row = rows.setdefault((cell["situation"], f"{cell['points']:,}"), [])
        row += [us_text(ns.get(name)) for name in own if name in ns or "bitmap" in name]
        row.append(f"{us_text(ns[best])} ({best})")
    head = ["tool is", "points", "first hit", "force", "on a bitmap", "other's hit"]
    head += ["how far", "other's"]
    return table(head, [[*place, *row] for place, row in rows.items()])


def exactness(results: Results) -> str:
    """Difference of the proved distances of removal paths from coal's."""
    rows = [row for row in results["removal_paths"]["rows"] if "length_m" in row]
    apart = [1e3 * (row["mesh_distance_m"] - row["gap_m"]) for row in rows]
    return (
        f"- {len(rows)} ways out of the sample car were proved free. coal's distance at "
        f"4,000 places of each is above the proved gap by {min(apart):.3f} to {max(apart):.3f} mm."
    )


def conditions(results: Results) -> str:
    """Of the figures; and the commits of what others measured."""
    own = results["figure9"]
    others: dict[str, list[str]] = {}
    for name, found in results.items():
        if (commit := found.get("commit", own["commit"])) != own["commit"]:
            others.setdefault(commit, []).append(name)
    said = "; ".join(f"{', '.join(names)}: {commit}" for commit, names in others.items())
    return facts(own, "load") + f"\n- other commits: {said}" * bool(said)


EVALUATION: dict[str, Callable[[Results], str]] = {
    "summary": summary,
    "claim": claim,
    "visits": visits,
    "table1": table_1,
    "figure9-counts": figure_9,
    "figure10-counts": figure_10,
    "grouping": grouping,
    "many": many,
    "exactness": exactness,
    "speed": speed,
    "costs": costs,
    "waits": waits,
    "pulls": pulls,
    "clashes-seconds": clash_seconds,
    "hands": hands,
    "growth": growth,
    "scale-growth": scale_growth,
    "evaluation-conditions": conditions,
}
"""The tables of the evaluation by their names."""
