"""The tables of docs/evaluation.md, made from measured cells."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from page_tables import NONE, facts, listed, table, us_text
from paper.cells import (
    FRAME_US,
    IN_THE_SERVER,
    ONE_STATEMENT,
    WHERE,
    Cell,
    Results,
    by_strategy,
    distinct,
    grouped,
    named,
    place_of,
    typical,
    with_paper_cache,
)

CLOSE = 1.05
"""CBGroup counts as good as the best MAXGAP up to this ratio of their times."""
AUTO_CLOSE = 1.10
"""`auto` counts as good as the best strategy up to this ratio of their times."""
FORMS = {ONE_STATEMENT: "In one statement", IN_THE_SERVER: "In a loop in the server"}


def cells_of(results: Results, name: str) -> Sequence[Cell]:
    """Cells of an experiment."""
    cells: Sequence[Cell] = results[name]["cells"]
    return cells


def count_text(value: float) -> str:
    """Whole number with commas; a number below 100 that is not whole keeps one decimal."""
    return f"{value:,.1f}" if value < 100 and value != round(value) else f"{value:,.0f}"


def bytes_text(value: float) -> str:
    """Bytes in MB or GB, three digits."""
    size, unit = (1e9, "GB") if value >= 1e9 else (1e6, "MB")
    return f"{value / size:,.3g} {unit}"


def time_text(cell: Cell | None) -> str:
    """Typical time of a cell, with a star where the time limit ended it."""
    return NONE if cell is None else us_text(typical(cell)) + "*" * bool(cell.get("cut_short"))


def table_1(results: Results) -> str:
    """Voxels, objects and cells of the data space."""
    return listed(
        cells_of(results, "table1"),
        {
            "environment": lambda cell: cell["environment"],
            "objects": lambda cell: f"{cell['objects']:,}",
            "object voxels": lambda cell: f"{cell['object_voxels']:,}",
            "distinct voxels": lambda cell: f"{cell['distinct_voxels']:,}",
            "cells of the data space": lambda cell: (
                f"{cell['cells_of_space']:.2g} ({cell['bits']} bits an axis)"
            ),
            "rows (bricks)": lambda cell: f"{cell['rows_brick']:,}",
            "size (bricks)": lambda cell: bytes_text(cell["bytes_brick"]),
        },
    )


def figure_8(results: Results) -> str:
    """Times by resolution, the grouping's own in brackets."""
    cells = cells_of(results, "figure8")
    resolutions = [n for n in distinct(cells, "resolution") if f"{n}".rstrip("0") == "1"]
    rows = []
    for group in grouped(cells).values():
        by = {cell["resolution"]: cell for cell in group}
        rows.append(
            [
                place_of(group[0], cells),
                *(f"{time_text(by[n])} ({us_text(by[n]['grouping_us'])})" for n in resolutions),
            ]
        )
    return table(["", *(f"{n:,}" for n in resolutions)], rows)


# --- Figures 9 and 10 -----------------------------------------------------------------------------


class Contest(NamedTuple):
    """MaxGap's fastest cell and CBGroup's, in one form under the same conditions."""

    form: str
    best: Cell
    cbgroup: Cell
    array: Cell | None

    @property
    def ratio(self) -> float:
        """CBGroup's time as a multiple of the best MAXGAP's."""
        return typical(self.cbgroup) / typical(self.best)


def contests(cells: Sequence[Cell]) -> Iterator[Contest]:
    """A contest for each set of conditions and each form."""
    for values, group in grouped(cells, (*WHERE, "form")).items():
        of = {
            strategy: sorted((c for c in group if c["strategy"] == strategy), key=typical)
            for strategy in ("maxgap", "cbgroup", "array")
        }
        if of["maxgap"] and of["cbgroup"]:
            array = of["array"][0] if of["array"] else None
            yield Contest(values[-1], of["maxgap"][0], of["cbgroup"][0], array)


def contest_table(name: str) -> Callable[[Results], str]:
    """The best MAXGAP, CBGroup and `array` of each contest with the paper's cache."""

    def of(results: Results) -> str:
        found = list(contests(with_paper_cache(cells_of(results, name))))
        has_loop = any(one.form == IN_THE_SERVER for one in found)
        rows = []
        for one in found:
            own = one.cbgroup
            rows.append(
                [
                    place_of(own, [other.cbgroup for other in found]),
                    *([one.form] if has_loop else []),
                    f"{one.best['maxgap']:,}",
                    time_text(one.best),
                    time_text(own),
                    *(count_text(own[key]) for key in ("ranges", "false_rows") if has_loop),
                    f"{one.ratio:.2f}",
                    time_text(one.array),
                ]
            )
        head = ["", *(["form"] if has_loop else []), "best MAXGAP", "its us", "CBGroup's us"]
        head += ["ranges", "false rows"] if has_loop else []
        return table([*head, "ratio", "`array`, us"], rows)

    return of


def contest_counts(name: str) -> Callable[[Results], str]:
    """In how many contests CBGroup is as good as the best MAXGAP."""

    def of(results: Results) -> str:
        lines = []
        for form, words in FORMS.items():
            own = [one for one in contests(cells_of(results, name)) if one.form == form]
            close = sum(one.ratio <= CLOSE for one in own)
            quick = sum(typical(one.cbgroup) < FRAME_US for one in own)
            if own:
                lines.append(
                    f"- {words}, CBGroup is within 5 % of the best MAXGAP, or better, in {close} "
                    f"of {len(own)} cases, and takes less than 1 ms in {quick}. The worst ratio is "
                    f"{max(one.ratio for one in own):.2f}."
                )
        return "\n".join(lines)

    return of


# --- the others -----------------------------------------------------------------------------------


def strategies(name: str, *, without: Sequence[object] = ()) -> Callable[[Results], str]:
    """Typical time of every strategy; without some of the strategies and of the poses."""

    def of(results: Results) -> str:
        cells = [
            cell
            for cell in cells_of(results, name)
            if cell["strategy"] not in without and cell["poses"] not in without
        ]
        shown = distinct(cells, "strategy")
        rows = []
        for group in grouped(cells).values():
            by = by_strategy(group)
            texts = [time_text(by.get(strategy)) for strategy in shown]
            rows.append([place_of(group[0], cells), *texts])
        return table(["", *map(named, shown)], rows)

    return of


def tail(results: Results) -> str:
    """Percentiles and the worst frame, in microseconds."""
    cells = cells_of(results, "tail")
    rows = [
        [
            place_of(cell, cells),
            named(cell["strategy"]),
            *(us_text(cell["us"][p]) for p in ("p50", "p99", "p99.9", "max")),
        ]
        for group in grouped(cells, (*WHERE, "strategy")).values()
        for cell in group
        if cell["strategy"] != "auto"
    ]
    return table(["", "strategy", "p50", "p99", "p99.9", "worst"], rows)


def auto(results: Results) -> str:
    """`auto` beside the fastest strategy of every group of cells measured together.

    Groups with a cell that the time limit ended are left out: they have other poses.
    """
    ratios: dict[tuple[str, str], list[float]] = {}
    for name, result in results.items():
        cells = [c for c in result.get("cells", ()) if "strategy" in c and "us" in c]
        keys = (*WHERE, "object_voxels") if name == "scale" else WHERE
        for group in grouped((c for c in cells if not c.get("cut_short")), keys).values():
            by = by_strategy(group)
            own = by.pop("auto", None)
            if own is not None and by:
                ratio = typical(own) / min(map(typical, by.values()))
                ratios.setdefault((own["engine"], own["layout"]), []).append(ratio)
    rows = []
    for (engine, layout), found in ratios.items():
        found.sort()
        counts = len(found), sum(ratio <= AUTO_CLOSE for ratio in found)
        middle_and_worst = found[len(found) // 2], found[-1]
        numbers = [*map(str, counts), *(f"{ratio:.2f}" for ratio in middle_and_worst)]
        rows.append([engine, named(layout), *numbers])
    return table(["engine", "layout", "groups", "within 10 %", "middle ratio", "worst"], rows)


def scale_times(results: Results) -> str:
    """Typical microseconds a frame by the number of object voxels."""
    cells = [c for c in cells_of(results, "scale") if c.get("strategy") in {"array", "cbgroup"}]
    sizes = distinct(cells, "object_voxels")
    rows = []
    for (engine, poses, strategy), group in grouped(cells, ("engine", "poses", "strategy")).items():
        by = {cell["object_voxels"]: time_text(cell) for cell in group}
        rows.append([f"{engine}, {poses}, {named(strategy)}", *(by.get(n, NONE) for n in sizes)])
    return table(["", *(f"{n:,}" for n in sizes)], rows)


def scale_growth(results: Results) -> str:
    """The largest environment's time over that of one car, for each engine and kind of poses."""
    whole = [c for c in cells_of(results, "scale") if "us" in c and c["copies"] >= 1]
    lines = []
    for (engine, poses), group in grouped(whole, ("engine", "poses")).items():
        growths = []
        for own in grouped(group, ("strategy",)).values():
            own.sort(key=lambda cell: float(cell["object_voxels"]))
            growths.append(typical(own[-1]) / typical(own[0]))
        most = max(cell["copies"] for cell in group)
        lines.append(
            f"- {engine}, {poses} poses: {most:,} times the voxels take {min(growths):.2f} to "
            f"{max(growths):.2f} times the time a frame."
        )
    return "\n".join(lines)


def storage(results: Results) -> str:
    """Rows, bytes and seconds of an import by the environment's size."""
    rows = []
    for group in grouped(cells_of(results, "scale"), ("engine", "object_voxels")).values():
        cell = group[0]
        rows.append(
            [
                cell["engine"],
                f"{cell['object_voxels']:,}",
                f"{cell['rows']:,}",
                bytes_text(cell["bytes"]),
                f"{cell['bytes_per_voxel']:.2f}",
                f"{cell['import_s']:,.3g}",
            ]
        )
    return table(
        ["engine", "object voxels", "rows", "size", "bytes a voxel", "written in, s"], rows
    )


EVALUATION: dict[str, Callable[[Results], str]] = {
    "table1": table_1,
    "figure8": figure_8,
    "figure9": contest_table("figure9"),
    "figure9-counts": contest_counts("figure9"),
    "figure10": contest_table("figure10"),
    "figure10-counts": contest_counts("figure10"),
    "conditions": strategies("conditions", without=["maxgap", "auto"]),
    "strategies": strategies("strategies", without=["random", "auto"]),
    "layouts": strategies("layouts", without=["auto"]),
    "points": strategies("points", without=["auto"]),
    "tail": tail,
    "auto": auto,
    "scale-times": scale_times,
    "scale-growth": scale_growth,
    "storage": storage,
    "evaluation-conditions": lambda results: facts(results["figure9"]),
}
"""The tables of the evaluation by their names."""
