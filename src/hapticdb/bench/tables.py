"""Measured cells as Markdown tables, one function an experiment."""

from collections import Counter
from collections.abc import Sequence

from hapticdb.bench.cells import (
    FRAME_US,
    IN_THE_SERVER,
    WHERE,
    Cell,
    distinct,
    frame_us,
    grouped,
    least,
    named,
    number,
    with_strategy,
    word,
)
from hapticdb.bench.contests import Contest, contests
from hapticdb.bench.markdown import (
    NONE,
    count_text,
    listed,
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

COST_COLUMNS = (
    ("statement", "statement of ranges"),
    ("descent", "a range more"),
    ("row_scanned", "a row more"),
    ("lookup", "statement of keys"),
    ("probe", "a key more"),
    ("caution", "caution"),
    ("gap_rows", "a gap is closed up to rows"),
)


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


def best_maxgap(cells: Sequence[Cell]) -> str:
    """Figures 9 and 10: the best MAXGAP and CBGroup wherever both were measured."""
    return contest_table(contests(cells))


def contest_table(found: Sequence[Contest]) -> str:
    """The best MAXGAP, CBGroup and `array` of each contest."""
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


def costs(cells: Sequence[Cell]) -> str:
    """Fitted figures, microseconds, and the rows up to which a gap is closed."""
    rows = [
        [place_of(cell, cells), *(_figure(cell, key) for key, _ in COST_COLUMNS)] for cell in cells
    ]
    said = (
        "Microseconds, fitted to the opened database before it was measured. Caution is how many "
        "times its expected rows a gap counts: the factor that would have cost least at the places "
        "of the calibration."
    )
    return paragraphs(said, table(["", *(name for _, name in COST_COLUMNS)], rows)) if rows else ""


def _figure(cell: Cell, key: str) -> str:
    value = number(cell, key)
    return NONE if value is None else f"{value:,.3g}"


def by_strategy(cells: Sequence[Cell]) -> str:
    """Typical time and p99 of every strategy, and which is fastest how often."""
    known = [cell for cell in cells if frame_us(cell) is not None and word(cell, "strategy")]
    strategies = distinct(known, "strategy")
    rows, fastest = [], Counter[str]()
    for group in grouped(known, WHERE).values():
        by = {strategy: least(with_strategy(group, strategy), frame_us) for strategy in strategies}
        rows.append([place_of(group[0], known), *(_typical_and_p99(by[s]) for s in strategies)])
        best = least(group, frame_us)
        if best is not None and len(group) > 1:
            fastest[named(best["strategy"])] += 1
    counts = listed(f"{name} in {n}" for name, n in fastest.most_common())
    said = "Microseconds a frame: typical, and in brackets p99."
    told = f"Fastest by the typical frame: {counts} of {fastest.total()} rows." if fastest else ""
    return paragraphs(said, table(["", *map(named, strategies)], rows), told) if rows else ""


def _typical_and_p99(cell: Cell | None) -> str:
    if cell is None:
        return NONE
    slow = frame_us(cell, "p99")
    return time_text(cell) + (f" ({us_text(slow)})" if slow is not None else "")


def tail(cells: Sequence[Cell]) -> str:
    """Percentiles and the worst frame, and the frames a second that follow from p99."""
    known = [cell for cell in cells if frame_us(cell, "p50") is not None]
    rows = []
    for group in grouped(known, (*WHERE, "strategy")).values():
        for cell in group:
            slow = frame_us(cell, "p99")
            times = [time_text(cell, m) for m in ("p50", "p99", "p99.9", "max")]
            second = count_text(1e6 / slow if slow is not None else None)
            frames = count_text(cell.get("frames"))
            strategy = named(word(cell, "strategy"))
            rows.append([place_of(cell, known), strategy, *times, second, frames])
    head = ["", "strategy", "p50", "p99", "p99.9", "worst", "frames a second by p99", "frames"]
    slows = [slow for cell in known if (slow := frame_us(cell, "p99")) is not None]
    quick = sum(slow <= FRAME_US for slow in slows)
    told = f"99 in 100 frames take 1 ms or less in {quick} of {len(slows)} rows." if slows else ""
    return paragraphs(table(head, rows), told)
