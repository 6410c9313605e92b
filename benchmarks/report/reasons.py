"""Why times differ: sentences that the cells themselves bear out, and no others."""

import re
from collections.abc import Callable, Iterable, Sequence

from hapticdb.bench.cells import (
    IN_THE_SERVER,
    ONE_STATEMENT,
    Cell,
    distinct,
    frame_us,
    grouped,
    number,
    ratio,
)
from hapticdb.bench.contests import CLOSE, Contest
from hapticdb.bench.markdown import count_text, listed, place_of, ratio_text, us_text

UNLIKE = 1.25
"""Ranges of one over the other's from which they ask differently."""
GROUPS_KEYS_ITSELF = 17
"""Since this version of PostgreSQL `= ANY` reads a leaf page once for all sorted keys on it."""


def why_cbgroup_is_off(contests: Sequence[Contest]) -> list[str]:
    """What CBGroup asked for where it is more than 5 % behind, beside what the best MAXGAP did."""
    where = [contest.where for contest in contests]
    said = []
    for contest in contests:
        ranges, best_ranges = number(contest.cbgroup, "ranges"), number(contest.best, "ranges")
        rows, best_rows = number(contest.cbgroup, "rows"), number(contest.best, "rows")
        if contest.is_close or None in {ranges, best_ranges, rows, best_rows}:
            continue
        verdict = _verdict(ranges or 0.0, best_ranges or 0.0)
        said.append(
            f"{place_of(contest.where, where)}{_in_form(contest)}: CBGroup reads "
            f"{count_text(rows)} rows in {count_text(ranges)} ranges, MAXGAP "
            f"{contest.best_maxgap:,} reads {count_text(best_rows)} in {count_text(best_ranges)}; "
            f"{verdict}."
        )
    return said


def _verdict(ranges: float, best_ranges: float) -> str:
    if ranges > UNLIKE * best_ranges:
        return "CBGroup closes fewer gaps than pays here"
    if best_ranges > UNLIKE * ranges:
        return "CBGroup closes more gaps than pays here"
    return "they ask for nearly the same, which does not explain the time: noise is as large"


def _in_form(contest: Contest) -> str:
    return ", in the loop" if contest.form == IN_THE_SERVER else ""


def why_array_wins(contests: Sequence[Contest]) -> list[str]:
    """Where one statement of all keys is faster than CBGroup, and the engine's part in it."""
    said = []
    compared = [contest for contest in contests if contest.array_ratio is not None]
    for engine in distinct([contest.where for contest in compared], "engine"):
        beside = [contest for contest in compared if contest.where.get("engine") == engine]
        own = [contest for contest in beside if (contest.array_ratio or 1.0) < 1 / CLOSE]
        if own:
            span = _span([contest.array_ratio or 1.0 for contest in own], 2)
            told = f"On {engine} `array` takes {span} of CBGroup's time"
            told += "." if len(own) == len(beside) else f" in {len(own)} of {len(beside)} cases."
            said.append(" ".join(filter(None, [told, _why_array(str(engine), own)])))
    return said


def _why_array(engine: str, contests: Sequence[Contest]) -> str:
    """What is known of the engine; else what the counts say."""
    version = re.match(r"PostgreSQL (\d+)", engine)
    if version and int(version[1]) >= GROUPS_KEYS_ITSELF:
        return (
            "Since version 17 `= ANY` reads each leaf page once for all sorted keys on it: the "
            "engine does the paper's grouping itself, and reads no row that was not asked for."
        )
    worst = min(contests, key=lambda contest: contest.array_ratio or 1.0)
    false, rows = number(worst.cbgroup, "false_rows"), number(worst.cbgroup, "rows")
    if not false or rows is None:
        return ""
    place = place_of(worst.where, [contest.where for contest in contests])
    return (
        f"Of the {count_text(rows)} rows that CBGroup reads a frame ({place}), {count_text(false)} "
        "were not asked for; `array` reads none of those."
    )


def why_loop_differs(contests: Sequence[Contest]) -> list[str]:
    """What a range costs more in a loop inside the server, engine by engine."""
    said = []
    for engine in distinct([contest.where for contest in contests], "engine"):
        slower, most, gaps = [], [], []
        for one, looped in _both_forms([c for c in contests if c.where.get("engine") == engine]):
            apart = _range_costs_more(one, looped)
            at_once, in_loop = one.at(0), looped.at(0)
            if apart is not None:
                slower.append(apart)
            if at_once and in_loop:
                most.append(ratio(frame_us(in_loop), frame_us(at_once)) or 1.0)
            gaps.append((one.best_maxgap, looped.best_maxgap))
        if not slower or min(slower) <= 0:
            continue
        told = (
            f"On {engine} a range costs {_span(slower)} us more in the loop than in one statement"
        )
        told += f", so that MAXGAP 0 takes {_span(most)} times as long" if most else ""
        if gaps and all(looped > one for one, looped in gaps):
            told += "; the best MAXGAP is larger there, since closing a gap saves more"
        said.append(f"{told}.")
    return said


def _both_forms(contests: Sequence[Contest]) -> Iterable[tuple[Contest, Contest]]:
    looped = {str(c.where): c for c in contests if c.form == IN_THE_SERVER}
    for one in contests:
        if one.form == ONE_STATEMENT and str(one.where) in looped:
            yield one, looped[str(one.where)]


def _range_costs_more(one: Contest, looped: Contest) -> float | None:
    """Time that the loop takes more, over the ranges that it takes more for; least squares."""
    pairs = []
    for cell in looped.curve:
        other = one.at(int(number(cell, "maxgap") or 0))
        slow, ranges = frame_us(cell), number(cell, "ranges")
        fast = frame_us(other) if other else None
        if slow is not None and fast is not None and ranges is not None:
            pairs.append((ranges, slow - fast))
    if len(pairs) < 2:
        return None
    mean_x = sum(x for x, _ in pairs) / len(pairs)
    mean_y = sum(y for _, y in pairs) / len(pairs)
    spread = sum((x - mean_x) ** 2 for x, _ in pairs)
    return sum((x - mean_x) * (y - mean_y) for x, y in pairs) / spread if spread else None


def _span(values: Sequence[float], places: int = 1) -> str:
    low, high = f"{min(values):,.{places}f}", f"{max(values):,.{places}f}"
    return low if low == high else f"{low} to {high}"


def how_regions_differ(contests: Sequence[Contest]) -> list[str]:
    """What one MAXGAP for all regions costs beside CBGroup, for each engine and layout."""
    said = []
    keys = ("engine", "layout", "cache", "file")
    own = [contest for contest in contests if contest.form == ONE_STATEMENT]
    wheres = [contest.where for contest in own]
    for group in grouped(wheres, keys).values():
        regional = [contest for contest in own if contest.where in group]
        best = best_for_all(regional)
        if len(regional) < 2 or best is None:
            continue
        gap, worst = best
        cbgroup = max(contest.cbgroup_ratio for contest in regional)
        whole = {key: value for key, value in group[0].items() if key != "region"}
        others = [{k: v for k, v in where.items() if k != "region"} for where in wheres]
        choice = listed(f"{c.best_maxgap:,} ({c.where.get('region')})" for c in regional)
        said.append(
            f"{place_of(whole, others)}: the best MAXGAP is {choice}. The one MAXGAP that serves "
            f"all regions best, {gap:,}, takes up to {ratio_text(worst)} of the best in one of "
            f"them, CBGroup up to {ratio_text(cbgroup)}: {_adapts(cbgroup, worst)}."
        )
    return said


def best_for_all(regional: Sequence[Contest]) -> tuple[int, float] | None:
    """MAXGAP whose worst ratio to a region's best is least, and that ratio."""
    found = []
    for gap in sorted({int(number(cell, "maxgap") or 0) for c in regional for cell in c.curve}):
        cells = [contest.at(gap) for contest in regional]
        ratios = [
            ratio(frame_us(cell), frame_us(contest.best))
            for cell, contest in zip(cells, regional, strict=True)
            if cell is not None
        ]
        known = [value for value in ratios if value is not None]
        if len(known) == len(regional):
            found.append((max(known), gap))
    return (min(found)[1], min(found)[0]) if found else None


def _adapts(cbgroup: float, one_maxgap: float) -> str:
    if cbgroup <= CLOSE:
        return "it adapts to the density"
    if cbgroup < one_maxgap:
        return "it adapts better than any one MAXGAP, though not to 5 %"
    return "one MAXGAP does as well or better here"


def how_resolution_matters(cells: Sequence[Cell]) -> list[str]:
    """What too coarse a quantile vector costs, and what a fine one costs the grouping."""
    said = []
    for group in grouped(cells, ("engine", "layout", "cache", "file")).values():
        timed = _by_resolution(group, frame_us)
        if len(timed) > 1:
            parts = [_coarse_costs(timed), _grouping_costs(group)]
            said.append(f"{place_of(group[0], cells)}: {'. '.join(filter(None, parts))}.")
    return said


def _by_resolution(
    cells: Iterable[Cell], measure: Callable[[Cell], float | None]
) -> list[tuple[float, float]]:
    return sorted(
        (buckets, us)
        for cell in cells
        if (buckets := number(cell, "resolution")) and (us := measure(cell)) is not None
    )


def _coarse_costs(timed: Sequence[tuple[float, float]]) -> str:
    best = min(us for _, us in timed)
    enough = next(n for n, us in timed if us <= CLOSE * best)
    later = max(us for n, us in timed if n >= enough)
    within = "from {} buckets on" if later <= CLOSE * best else "at {} buckets for the first time"
    return (
        f"with {timed[0][0]:,.0f} buckets a frame takes {ratio_text(timed[0][1] / best)} of the "
        f"fastest resolution's time; {within.format(f'{enough:,.0f}')} it is within 5 % of that"
    )


def _grouping_costs(cells: Iterable[Cell]) -> str:
    alone = _by_resolution(cells, lambda cell: number(cell, "grouping_us"))
    if len(alone) < 2:
        return ""
    (fewest, short), (most, long) = alone[0], alone[-1]
    return (
        f"The grouping alone takes {us_text(short)} us with {fewest:,.0f} buckets and "
        f"{us_text(long)} with {most:,.0f}"
    )


def what_gaps_pay(cells: Sequence[Cell]) -> list[str]:
    """What a range more costs beside a row, and beside a key of `array`."""
    said = []
    for cell in cells:
        descent, row, probe = (number(cell, key) for key in ("descent", "row_scanned", "probe"))
        if not descent or not row or probe is None:
            continue
        said.append(
            f"{place_of(cell, cells)}: a range more costs as much as {descent / row:,.1f} rows, "
            f"and {_beside(descent, probe)}."
        )
    return said


def _beside(descent: float, probe: float) -> str:
    if probe <= 0.0:
        return "a key of `array` too little to be measured"
    if descent > probe:
        return f"{descent / probe:,.1f} times a key of `array`"
    return f"{descent / probe:,.2f} of a key of `array`, so that a range of two keys pays"
