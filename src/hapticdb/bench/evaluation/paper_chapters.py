"""The evaluation's chapters on Table 1 and Figures 8, 9 and 10."""

from collections.abc import Iterable, Sequence

from hapticdb.bench.cells import (
    IN_THE_SERVER,
    ONE_STATEMENT,
    WHERE,
    Cell,
    distinct,
    frame_us,
    grouped,
    number,
    word,
)
from hapticdb.bench.evaluation.findings import Contest, contests
from hapticdb.bench.evaluation.prose import (
    NONE,
    bullets,
    bytes_text,
    count_text,
    paragraphs,
    place_of,
    ratio_text,
    table,
    time_text,
    us_text,
)

CONTEST_HEAD = (
    "best MAXGAP",
    "within 5 % of it",
    "its us",
    "ranges",
    "rows",
    "CBGroup's us",
    "ranges",
    "rows",
    "false rows",
    "ratio",
)
FORMS = {ONE_STATEMENT: "In one statement", IN_THE_SERVER: "In a loop in the server"}
FRAME = 1000.0
"""Microseconds that a frame may take at 1000 a second."""


def table1(cells: Sequence[Cell]) -> str:
    """Voxels, objects and cells of the data space."""
    head = (
        "environment", "objects", "object voxels", "distinct voxels", "cells of the data space",
        "extent, longest sides", "rows (bricks)", "size (bricks)",
    )  # fmt: skip
    rows = [
        (
            word(cell, "environment") or NONE,
            count_text(number(cell, "objects")),
            count_text(number(cell, "object_voxels")),
            count_text(number(cell, "distinct_voxels")),
            _space(cell),
            _plain(number(cell, "extent")),
            count_text(number(cell, "rows_brick")),
            bytes_text(number(cell, "bytes_brick")),
        )
        for cell in cells
    ]
    return table(head, rows)


def _plain(value: float | None) -> str:
    return NONE if value is None else f"{value:g}"


def _space(cell: Cell) -> str:
    space, bits = number(cell, "cells_of_space"), number(cell, "bits")
    if space is None:
        return NONE
    return f"{space:.2g}" + (f" ({bits:.0f} bits an axis)" if bits is not None else "")


def figure8(cells: Sequence[Cell]) -> str:
    """Times by resolution, the grouping's own in brackets."""
    known = [cell for cell in cells if frame_us(cell) and number(cell, "resolution")]
    resolutions = distinct(known, "resolution")
    rows = []
    keys = [key for key in WHERE if key != "region"]
    for group in grouped(known, keys).values():
        by = {cell["resolution"]: cell for cell in group}
        rows.append([place_of(group[0], known), *(_with_grouping(by.get(n)) for n in resolutions)])
    said = "Microseconds a frame by the number of buckets; in brackets the grouping's own."
    return paragraphs(said, table(["", *(f"{n:,}" for n in resolutions)], rows)) if rows else ""


def _with_grouping(cell: Cell | None) -> str:
    if cell is None:
        return NONE
    grouping = number(cell, "grouping_us")
    return time_text(cell) + (f" ({us_text(grouping)})" if grouping is not None else "")


def best_against_cbgroup(cells: Sequence[Cell]) -> str:
    """Figures 9 and 10: the best MAXGAP and CBGroup wherever both were measured."""
    found = contests(cells)
    if not found:
        return ""
    return paragraphs(_contest_table(found), bullets(_contest_sentences(found)), _off(found))


def _contest_table(found: Sequence[Contest]) -> str:
    has_array = any(contest.array for contest in found)
    has_loop = any(contest.form == IN_THE_SERVER for contest in found)
    head = ["", *(["form"] if has_loop else []), *CONTEST_HEAD]
    head += ["`array`, us"] if has_array else []
    where = [contest.where for contest in found]
    rows = []
    for contest in found:
        low, high = contest.plateau
        best, own = contest.best, contest.cbgroup
        rows.append(
            [
                place_of(contest.where, where),
                *([contest.form] if has_loop else []),
                f"{contest.best_maxgap:,}",
                f"{low:,}" if low == high else f"{low:,} to {high:,}",
                time_text(best),
                count_text(number(best, "ranges")),
                count_text(number(best, "rows")),
                time_text(own),
                count_text(number(own, "ranges")),
                count_text(number(own, "rows")),
                count_text(number(own, "false_rows")),
                ratio_text(contest.cbgroup_ratio),
                *([time_text(contest.array) if contest.array else NONE] if has_array else []),
            ]
        )
    return table(head, rows)


def _contest_sentences(found: Sequence[Contest]) -> Iterable[str]:
    for form, words in FORMS.items():
        own = [contest for contest in found if contest.form == form]
        if not own:
            continue
        close = sum(contest.is_close for contest in own)
        faster = sum(contest.cbgroup_ratio < 1 for contest in own)
        quick = sum((frame_us(contest.cbgroup) or FRAME) < FRAME for contest in own)
        yield (
            f"{words}, CBGroup is within 5 % of the best MAXGAP, or better, in {close} of "
            f"{len(own)} cases, and faster than every MAXGAP in {faster}. Its typical frame takes "
            f"less than 1 ms in {quick}."
        )


def _off(found: Sequence[Contest]) -> str:
    off = sorted((c for c in found if not c.is_close), key=lambda c: -c.cbgroup_ratio)
    if not off:
        return ""
    where = [contest.where for contest in found]
    items = [f"{place_of(c.where, where)}, {c.form}: {ratio_text(c.cbgroup_ratio)}" for c in off]
    return paragraphs("Where CBGroup is more than 5 % slower than the best MAXGAP:", bullets(items))
