"""The evaluation's chapters on Table 1 and on Figures 9 and 10."""

from collections.abc import Iterable, Sequence

from hapticdb.bench.cells import (
    FRAME_US,
    IN_THE_SERVER,
    ONE_STATEMENT,
    Cell,
    frame_us,
    number,
    word,
)
from hapticdb.bench.contests import Contest, contests
from hapticdb.bench.markdown import (
    NONE,
    bullets,
    bytes_text,
    count_text,
    paragraphs,
    place_of,
    ratio_text,
    table,
)
from hapticdb.bench.tables import contest_table

FORMS = {ONE_STATEMENT: "In one statement", IN_THE_SERVER: "In a loop in the server"}


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


def best_against_cbgroup(cells: Sequence[Cell]) -> str:
    """Figures 9 and 10: the best MAXGAP and CBGroup wherever both were measured."""
    found = contests(cells)
    if not found:
        return ""
    return paragraphs(contest_table(found), bullets(_contest_sentences(found)), _off(found))


def _contest_sentences(found: Sequence[Contest]) -> Iterable[str]:
    for form, words in FORMS.items():
        own = [contest for contest in found if contest.form == form]
        if not own:
            continue
        close = sum(contest.is_close for contest in own)
        faster = sum(contest.cbgroup_ratio < 1 for contest in own)
        quick = sum((frame_us(contest.cbgroup) or FRAME_US) < FRAME_US for contest in own)
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
