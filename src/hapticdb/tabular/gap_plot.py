"""Plot of a gap curve as SVG: distances over the number of the pose."""

from collections.abc import Mapping
from html import escape
from itertools import groupby
from math import ceil
from typing import Any

COLOURS = ("#d1495b", "#2463a0", "#eb9f14", "#2e8b57", "#7b4ea3", "#17a2b8", "#8c5a2b", "#555f6b")
"""Of the nearest pairs; all others are grey, without a name."""
WIDTH, HEIGHT, LEFT, TOP, LINE, TICKS = 720, 360, 70, 20, 20, 5
"""Pixels of the axes' area, to its left, above, and of a line of text; parts of an axis."""
BELOW = TOP + HEIGHT + 2 * LINE


def gap_plot(columns: Mapping[str, Any]) -> str:
    """SVG of the columns of a `GapCurve`: proved distances, millimetres, a step an interval."""
    names = ("body", "name", "begin", "end", "at_least_m")
    rows = [*zip(*(columns[name] for name in names), strict=True)]
    pairs = [(pair, [*some]) for pair, some in groupby(rows, lambda row: row[:2])]
    last = ceil(max((row[3] for row in rows), default=0.0)) or 1
    most = 1e3 * max((row[4] for row in rows), default=0.0) or 1.0
    drawn = [_text(4, TOP - 6, "gap at least, mm"), _text(LEFT, BELOW, "number of the pose")]
    for k in range(TICKS + 1):
        x, y = LEFT + WIDTH * k / TICKS, TOP + HEIGHT * (1 - k / TICKS)
        drawn += [f'<path d="M{LEFT} {y:.1f}h{WIDTH}" stroke="#dde"/>']
        drawn += [_text(4, y + 4, f"{most * k / TICKS:.3g}")]
        drawn += [_text(x, TOP + HEIGHT + LINE, f"{last * k / TICKS:.4g}")]
    for n, (pair, some) in reversed([*enumerate(pairs)]):  # the nearest pair above the others
        colour, line, before = [*COLOURS, "#ccc"][min(n, len(COLOURS))], "", -1.0
        for _, _, begin, end, gap in some:
            x, y = LEFT + WIDTH * begin / last, TOP + HEIGHT * (1 - 1e3 * gap / most)
            # after a pause, the pair begins a new line
            line += f"{'L' if begin == before else 'M'}{x:.1f} {y:.1f}"
            line += f"H{LEFT + WIDTH * end / last:.1f}"
            before = end
        drawn += [f'<path d="{line}" fill="none" stroke="{colour}" stroke-width="1.5"/>']
        if n < len(COLOURS):
            words = f"{' and '.join(filter(None, pair))}: {1e3 * min(r[4] for r in some):.4g} mm"
            drawn += [_text(LEFT, BELOW + (n + 1) * LINE, words, colour)]
    size = f'width="{WIDTH + 2 * LEFT}" height="{BELOW + LINE * (len(COLOURS) + 1)}"'
    style = 'style="font:13px sans-serif;background:#fff"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}>{"".join(drawn)}</svg>\n'


def _text(x: float, y: float, words: str, colour: str = "#1c2530") -> str:
    shown = escape("".join(letter if letter.isprintable() else "?" for letter in words))
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}">{shown}</text>'
