"""The evaluation's chapters on peers, voxelizing and scale."""

import math
from collections.abc import Iterable, Sequence

from hapticdb.bench.cells import Cell, distinct, frame_us, grouped, named, number, ratio, word
from hapticdb.bench.markdown import (
    NONE,
    bullets,
    bytes_text,
    count_text,
    listed,
    paragraphs,
    place_of,
    ratio_text,
    table,
    time_text,
)
from report.findings import OURS, asks_the_same, is_ours

ALIKE = 1.1
"""Peers run one after another, and a machine drifts by as much meanwhile."""


def peers(cells: Sequence[Cell]) -> str:
    """Every system: what it answers, how fast, and what it cost to build."""
    known = sorted(
        (cell for cell in cells if frame_us(cell, "p50") is not None and word(cell, "peer")),
        key=lambda cell: frame_us(cell, "p50") or 0.0,
    )
    rows = [
        [
            word(cell, "peer"),
            word(cell, "question") or NONE,
            time_text(cell, "p50"),
            time_text(cell, "p99"),
            _percent(number(cell, "hits_agree")),
            _seconds(number(cell, "build_s")),
            _size(cell),
        ]
        for cell in known
    ]
    head = ["", "answers", "p50, us", "p99, us", "hits agree", "build, s", "size"]
    return paragraphs(table(head, rows), bullets(_peer_sentences(known)))


def _percent(share: float | None) -> str:
    if share is None:
        return NONE
    # what is not all must not be rounded to all
    return f"{100 * share:.0f} %" if share in {0.0, 1.0} else f"{min(100 * share, 99.99):.4g} %"


def _seconds(value: float | None) -> str:
    return NONE if value is None else f"{value:,.3g}"


def _size(cell: Cell) -> str:
    for key, where in (("memory_bytes", "memory"), ("file_bytes", "file")):
        size = number(cell, key)
        if size is not None:
            return f"{bytes_text(size)}, {where}"
    return NONE


def _peer_sentences(known: Sequence[Cell]) -> Iterable[str]:
    own = next((cell for cell in known if is_ours(cell)), None)
    rivals = [cell for cell in known if asks_the_same(cell) and not is_ours(cell)]
    if own is not None and rivals:
        factors = {
            word(c, "peer"): factor
            for c in rivals
            if (factor := ratio(frame_us(c, "p50"), frame_us(own, "p50"))) is not None
        }
        name = word(own, "peer")
        for kind, low, high in (
            ("Faster than", 0.0, 1 / ALIKE),
            ("As fast, within 10 %, as", 1 / ALIKE, ALIKE),
            ("Slower than", ALIKE, math.inf),
        ):
            times = [f"{n} ({ratio_text(f)})" for n, f in factors.items() if low < f <= high]
            if times:
                yield (
                    f"{kind} {name} at the same question (time as a multiple of its p50): "
                    f"{listed(times)}."
                )
    apart = [
        f"{word(cell, 'peer')} ({_percent(number(cell, 'hits_agree'))})"
        for cell in known
        if asks_the_same(cell)
        and (number(cell, "hits_agree") or 0.0) < 1
        and number(cell, "hits_agree") is not None
    ]
    if apart:
        yield f"Hits differ at some poses, though the question is the same: {listed(apart)}."


def voxelizing(cells: Sequence[Cell]) -> str:
    """Object voxels a second of each tool."""
    known = sorted(
        (cell for cell in cells if (number(cell, "voxels_per_second") or 0) > 0),
        key=lambda cell: -(number(cell, "voxels_per_second") or 0.0),
    )
    rows = [
        [
            word(cell, "tool") or NONE,
            count_text(number(cell, "parts")),
            count_text(number(cell, "object_voxels")),
            _seconds(number(cell, "seconds")),
            count_text(number(cell, "voxels_per_second")),
        ]
        for cell in known
    ]
    ours = next((cell for cell in known if word(cell, "tool").startswith(OURS)), None)
    others = [cell for cell in known if not word(cell, "tool").startswith(OURS)]
    told = [
        f"{word(cell, 'tool')} voxelizes {share} of hapticdb's voxels a second."
        for cell in others
        if ours and (share := _share(cell, ours))
    ]
    head = ["tool", "parts", "object voxels", "seconds", "object voxels a second"]
    return paragraphs(table(head, rows), bullets(told))


def _share(cell: Cell, ours: Cell) -> str:
    found = ratio(number(cell, "voxels_per_second"), number(ours, "voxels_per_second"))
    return "" if found is None else f"{found:.2g}"


def scale(cells: Sequence[Cell]) -> str:
    """Frame times, storage and import by the environment's size."""
    return paragraphs(_scale_times(cells), bullets(_growth(cells)), _storage(cells))


def _scale_times(cells: Sequence[Cell]) -> str:
    known = [cell for cell in cells if frame_us(cell) and number(cell, "object_voxels")]
    sizes = distinct(known, "object_voxels")
    rows = []
    for group in grouped(known, ("engine", "layout", "poses", "strategy")).values():
        by = {cell["object_voxels"]: time_text(cell) for cell in group}
        place = f"{place_of(group[0], known)}, {named(word(group[0], 'strategy'))}"
        rows.append([place, *(by.get(n, NONE) for n in sizes)])
    said = "Typical microseconds a frame by the number of object voxels."
    return paragraphs(said, table(["", *(f"{n:,.0f}" for n in sizes)], rows)) if rows else ""


def _growth(cells: Sequence[Cell]) -> Iterable[str]:
    """The largest environment's time over the smallest's, for each engine and kind of poses.

    Of whole copies: a part of one has other surfaces, and fewer of them.
    """
    timed = [
        cell
        for cell in cells
        if frame_us(cell)
        and number(cell, "object_voxels")
        and (number(cell, "copies") or 1.0) >= 1.0
    ]
    for (engine, poses), group in grouped(timed, ("engine", "poses")).items():
        found = []
        for own in grouped(group, ("layout", "strategy")).values():
            ends = sorted(own, key=lambda cell: number(cell, "object_voxels") or 0.0)
            times = ratio(frame_us(ends[-1]), frame_us(ends[0]))
            more = ratio(number(ends[-1], "object_voxels"), number(ends[0], "object_voxels"))
            if times is not None and more is not None and more > 1:
                found.append((more, times))
        if found:
            low, high = (f"{end(t for _, t in found):.2f}" for end in (min, max))
            span = low if low == high else f"{low} to {high}"
            place = ", ".join(str(part) for part in (engine, f"{poses} poses") if part)
            yield (
                f"{place}: {max(more for more, _ in found):,.0f} times the voxels take {span} "
                "times the time a frame."
            )


def _storage(cells: Sequence[Cell]) -> str:
    rows = []
    for (engine, voxels), group in grouped(cells, ("engine", "object_voxels")).items():
        cell = next((c for c in group if number(c, "bytes") is not None), None)
        if cell is not None and isinstance(voxels, int | float):
            rows.append(
                [
                    str(engine or NONE),
                    count_text(number(cell, "copies")),
                    count_text(voxels),
                    count_text(number(cell, "rows")),
                    bytes_text(number(cell, "bytes")),
                    ratio_text(number(cell, "bytes_per_voxel")),
                    _seconds(number(cell, "import_s")),
                ]
            )
    head = ["engine", "copies", "object voxels", "rows", "size", "bytes a voxel", "import, s"]
    return table(head, rows)
