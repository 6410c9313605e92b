"""The evaluation's chapters on what the paper leaves out: strategies, caches, curves, tails."""

from collections.abc import Sequence

from hapticdb.bench.cells import (
    FRAME_US,
    WHERE,
    Cell,
    Results,
    frame_us,
    grouped,
    least,
    named,
    number,
    word,
)
from hapticdb.bench.markdown import (
    bullets,
    count_text,
    listed,
    paragraphs,
    place_of,
    ratio_text,
    table,
    time_text,
)
from hapticdb.bench.tables import by_strategy
from report.findings import (
    AUTO_CLOSE,
    CHOOSABLE,
    AutoChoice,
    choices,
    repeats,
)

WORST_SHOWN = 12
"""Rows of the table in which `auto` is slow; more rows make a longer page."""


def conditions(cells: Sequence[Cell]) -> str:
    """All strategies by cache, and what the caches are worth."""
    cold, cached = (
        "With the file out of the operating system's cache",
        "With everything in the database's cache instead of 4 MB",
    )
    sentences = [
        _compared(cells, "file", "cold", "cached", cold),
        _compared(cells, "cache", "all cached", "4 MB", cached),
    ]
    return paragraphs(by_strategy(cells), bullets(filter(None, sentences)))


def layouts(cells: Sequence[Cell]) -> str:
    """All strategies by layout and curve, and what bricks and other curves are worth."""
    sentences = [
        _compared(cells, "layout", "brick", "voxel", "On bricks instead of voxels"),
        _compared(cells, "curve", "hilbert", "z-order", "On the Hilbert curve instead of Z-order"),
        _compared(cells, "curve", "lexicographic", "z-order", "In lexicographic order instead"),
    ]
    return paragraphs(by_strategy(cells), bullets(filter(None, sentences)))


def _compared(cells: Sequence[Cell], key: str, one: str, other: str, words: str) -> str:
    """Times under one value of a condition over those under another, all else equal."""
    rest = [name for name in (*WHERE, "strategy", "maxgap") if name != key]
    ratios = []
    for group in grouped(cells, rest).values():
        first = least([c for c in group if c.get(key) == one], frame_us)
        second = least([c for c in group if c.get(key) == other], frame_us)
        if first is not None and second is not None:
            ratios.append((frame_us(first) or 0.0) / (frame_us(second) or 1.0))
    if not ratios:
        return ""
    low, high = ratio_text(min(ratios)), ratio_text(max(ratios))
    span = low if low == high else f"{low} to {high} times"
    return f"{words} a frame takes {span} the time ({len(ratios)} pairs, all else equal)."


def points(cells: Sequence[Cell]) -> str:
    """All strategies by the number of points, and how many fit into a millisecond."""
    sentences = []
    rest = [name for name in WHERE if name != "points"]
    known = [{k: v for k, v in cell.items() if k != "points"} for cell in cells]
    for group in grouped(cells, rest).values():
        quick = [
            c for c in group if (frame_us(c) or FRAME_US) < FRAME_US and c.get("points") is not None
        ]
        place = place_of({k: v for k, v in group[0].items() if k != "points"}, known)
        if quick:
            most = max(quick, key=lambda cell: (cell["points"], -(frame_us(cell) or 0.0)))
            sentences.append(
                f"{place}: up to {most['points']:,} points were measured to take less than 1 ms "
                f"({named(word(most, 'strategy'))}, {time_text(most)} us)."
            )
        else:
            sentences.append(f"{place}: no typical frame took less than 1 ms.")
    return paragraphs(by_strategy(cells), bullets(sentences))


# --- auto ---------------------------------------------------------------------------------------


def auto(results: Results) -> str:
    """`auto` beside the fastest strategy of every group of cells measured together."""
    found = choices(results)
    if not found:
        return ""
    return paragraphs(
        _auto_sentences(found),
        _auto_summary(found),
        _auto_worst(found),
        _auto_noise(results, found),
    )


def _auto_sentences(found: Sequence[AutoChoice]) -> str:
    close = sum(choice.ratio <= AUTO_CLOSE for choice in found)
    own = [r for choice in found if (r := choice.choosable_ratio) is not None]
    told = f"`auto` is within 10 % of the fastest strategy, or faster, in {close} of {len(found)}"
    said = [f"{told} groups of cells that differ in nothing but the strategy."]
    if own:
        close = sum(r <= AUTO_CLOSE for r in own)
        told = f"Beside the fastest of {listed(CHOOSABLE)}, which it chooses among, it is so in"
        said.append(f"{told} {close} of {len(own)}.")
    return bullets(said)


def _auto_summary(found: Sequence[AutoChoice]) -> str:
    rows = []
    for (engine, layout), places in grouped([c.where for c in found], ("engine", "layout")).items():
        own = [choice for choice in found if any(choice.where is place for place in places)]
        ratios = sorted(choice.ratio for choice in own)
        rows.append(
            [
                str(engine or "-"),
                named(layout or "-"),
                str(len(own)),
                str(sum(r <= AUTO_CLOSE for r in ratios)),
                ratio_text(ratios[len(ratios) // 2]),
                ratio_text(ratios[-1]),
            ]
        )
    return table(["engine", "layout", "groups", "within 10 %", "middle ratio", "worst"], rows)


def _auto_worst(found: Sequence[AutoChoice]) -> str:
    off = sorted((c for c in found if c.ratio > AUTO_CLOSE), key=lambda c: -c.ratio)
    if not off:
        return ""
    where = [choice.where for choice in found]
    rows = [
        [
            choice.experiment,
            place_of(choice.where, where),
            time_text(choice.auto),
            choice.chosen or "-",
            f"{named(word(choice.best, 'strategy'))}{_maxgap_of(choice.best)}",
            time_text(choice.best),
            ratio_text(choice.ratio),
            ratio_text(choice.explained),
        ]
        for choice in off[:WORST_SHOWN]
    ]
    told = f"The worst of the {len(off)} others:" if len(off) > WORST_SHOWN else "The others:"
    head = ["experiment", "", "`auto`, us", "chose", "fastest", "its us", "ratio", "by its choices"]
    meant = (
        "By its choices: what the strategies that it chose took in cells of their own, by their "
        "shares; what the ratio exceeds that by is choosing, and noise."
    )
    return paragraphs(told, table(head, rows), meant)


def _auto_noise(results: Results, found: Sequence[AutoChoice]) -> str:
    """How far the numbers themselves can be trusted, as the run shows it."""
    said = []
    apart = repeats(results)
    if apart:
        said.append(
            f"{len(apart)} combinations were measured by several experiments of the run. Minutes "
            f"later they took {ratio_text(apart[len(apart) // 2])} times as long in the middle and "
            f"{ratio_text(apart[-1])} at most: the machine's speed drifts by as much. "
            "Strategies on one environment ran in turns, and luck still favours the fastest of "
            "several; engines, curves, sizes of the cache and peers ran one after another."
        )
    frames = [
        n
        for choice in found
        if choice.ratio > AUTO_CLOSE and word(choice.where, "file") == "cold"
        if (n := number(choice.auto, "frames")) is not None
    ]
    if frames:
        said.append(
            f"Cold cells have {count_text(min(frames))} frames, each from the disk, whose speed "
            "differs from frame to frame."
        )
    return bullets(said)


def _maxgap_of(cell: Cell) -> str:
    gap = cell.get("maxgap")
    return f" {gap:,}" if isinstance(gap, int) and not isinstance(gap, bool) else ""
