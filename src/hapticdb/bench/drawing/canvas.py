"""Style and layout of all plots: colours, type, panels, axes of microseconds."""

import textwrap
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator

from hapticdb.errors import FileError

INK = "#1f2328"
FAINT = "#59636e"
RULE = "#e3e6ea"
BLUE, ORANGE, GREEN, RED = "#0072b2", "#e69f00", "#009e73", "#d55e00"
PURPLE, SKY, GREY = "#aa4a89", "#56b4e9", "#7f7f7f"
"""Of Okabe and Ito's palette, which colour-blind eyes tell apart; the purple is darker."""
STRATEGY_COLORS = {
    "points": GREY,
    "statement": PURPLE,
    "array": BLUE,
    "maxgap": GREEN,
    "cbgroup": RED,
    "auto": INK,
}
STRATEGY_MARKERS = {
    "points": "v",
    "statement": "^",
    "array": "s",
    "maxgap": "D",
    "cbgroup": "o",
    "auto": "P",
}
ENGINE_COLORS = (BLUE, ORANGE, GREEN, PURPLE, SKY)
MARKERS = ("o", "s", "D", "^", "v")

WIDTH = 9.2
"""Inches; 883 pixels where an SVG is shown at its own size."""
LINE = 0.175
"""Inches from one line of text to the next."""
TEXT = 9.0
"""Points, 12 pixels: nothing is smaller."""
LETTERS = 132
"""Letters of such text that fit in a line."""
STYLE: dict[Any, Any] = {
    "font.family": ["sans-serif"],
    # an SVG names them all; text is laid out by the first, which is wider than the others
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial"],
    "font.size": TEXT,
    "text.color": INK,
    # a name from a user's file may hold a dollar sign
    "text.parse_math": False,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.labelsize": TEXT,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": TEXT,
    "ytick.labelsize": TEXT,
    "legend.fontsize": TEXT,
    "lines.linewidth": 1.6,
    "lines.markersize": 5,
    "svg.fonttype": "none",
    "svg.hashsalt": "hapticdb",
    "path.simplify": False,
}
Stroke = Literal["-", "--", ":", "none"]
CUT_SHORT = "Hollow marks: the time limit ended the cell early, so it has fewer frames."


@dataclass(frozen=True)
class Canvas:
    """A figure and its panels, row by row."""

    figure: Figure
    panels: list[list[Axes]]

    @property
    def every(self) -> list[Axes]:
        """All panels."""
        return [axes for row in self.panels for axes in row]


@dataclass(frozen=True)
class Framing:
    """What surrounds the panels, and how large they are.

    title, subtitle, notes : text above and below; legend : handles; height : inches of a panel;
    left, right, between, above : inches beside, between and over the panels.
    """

    title: str
    subtitle: str = ""
    notes: Sequence[str] = ()
    legend: Sequence[Artist] = ()
    height: float = 2.1
    left: float = 0.85
    right: float = 0.15
    between: float = 0.2
    above: float = 0.34


def lay_out(framing: Framing, rows: int = 1, columns: int = 1) -> Canvas:
    """Make a figure with rows x columns empty panels."""
    subtitle = _lines_of(framing.subtitle)
    notes = [line for note in framing.notes for line in textwrap.wrap(note, LETTERS)]
    in_row = _entries_in_a_row(framing.legend)
    legend_lines = -(-len(framing.legend) // in_row) if framing.legend else 0
    top = 0.4 + LINE * len(subtitle) + 0.22 * legend_lines
    bottom = 0.55 + LINE * len(notes) + (0.06 if notes else 0)
    down = rows * (framing.height + framing.above) + (rows - 1) * 0.25
    height = top + down + bottom
    figure = Figure(figsize=(WIDTH, height), facecolor="white")
    FigureCanvasSVG(figure)
    figure.text(0.12 / WIDTH, 1 - 0.25 / height, framing.title, fontsize=12.5, fontweight="bold")
    for number, line in enumerate(subtitle):
        y = 1 - (0.46 + LINE * number) / height
        figure.text(0.12 / WIDTH, y, line, color=FAINT)
    for number, line in enumerate(reversed(notes)):
        figure.text(0.12 / WIDTH, (0.1 + LINE * number) / height, line, color=FAINT)
    if framing.legend:
        _place_legend(figure, framing.legend, in_row, 1 - (0.36 + LINE * len(subtitle)) / height)
    room = WIDTH - framing.left - framing.right - (columns - 1) * framing.between
    width = room / columns
    lefts = [framing.left + n * (width + framing.between) for n in range(columns)]
    panels = []
    for row in range(rows):
        low = height - top - (row + 1) * (framing.height + framing.above) - row * 0.25
        boxes = [(x / WIDTH, low / height, width / WIDTH, framing.height / height) for x in lefts]
        panels.append([figure.add_axes(box) for box in boxes])
    return Canvas(figure, panels)


def _lines_of(conditions: str) -> list[str]:
    """Break between conditions, never inside one."""
    lines: list[str] = []
    for piece in filter(None, conditions.split("; ")):
        if lines and len(lines[-1]) + len(piece) + 2 <= LETTERS:
            lines[-1] += f"; {piece}"
        else:
            lines.append(piece)
    return lines


def _entries_in_a_row(legend: Sequence[Artist]) -> int:
    """Entries of the legend in one row: as many as fit.

    matplotlib fills columns from top to bottom; a column is as wide as its widest entry.
    """
    widths = [0.078 * len(str(entry.get_label())) + 0.62 for entry in legend]
    for columns in range(len(widths), 1, -1):
        parts = np.array_split(np.array(widths), columns)
        if sum(float(part.max()) for part in parts) <= WIDTH:
            return columns
    return 1


def _place_legend(figure: Figure, legend: Sequence[Artist], in_row: int, y: float) -> None:
    figure.legend(
        handles=list(legend),
        loc="upper left",
        bbox_to_anchor=(0.02 / WIDTH, y),
        ncol=in_row,
        frameon=False,
        borderaxespad=0.0,
        columnspacing=1.4,
        handlelength=2.2,
        handletextpad=0.5,
    )


def write(figure: Figure, path: Path) -> None:
    """Write a figure as an SVG: the same bytes for the same figure."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, format="svg", metadata={"Date": None, "Creator": "hapticdb"})
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error


def styled() -> AbstractContextManager[None]:
    """While it is entered, matplotlib draws in this style."""
    return mpl.rc_context(STYLE)


def entry(
    label: str, color: str, *, line: Stroke = "none", marker: str = "", width: float = 1.6
) -> Line2D:
    """Legend's sample of a line or mark."""
    return Line2D([], [], color=color, label=label, linestyle=line, marker=marker, linewidth=width)


def head(axes: Axes, left: str, right: str = "") -> None:
    """Title of a panel at its left end, and a figure that follows from it at its right end."""
    axes.set_title(left, loc="left", fontsize=TEXT, fontweight="bold", pad=7)
    if right:
        axes.set_title(right, loc="right", fontsize=TEXT, color=FAINT, pad=7)


def not_measured(axes: Axes) -> None:
    """Say that a panel has no cells."""
    axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", color=FAINT)


def marks(
    axes: Axes,
    places: Sequence[tuple[float, float, bool]],
    color: str,
    marker: str = "o",
    size: float = 5,
) -> None:
    """Draw marks at (x, y), hollow where the third says so."""
    for hollow in (False, True):
        chosen = [(x, y) for x, y, is_hollow in places if is_hollow is hollow]
        if chosen:
            axes.plot(
                [x for x, _ in chosen],
                [y for _, y in chosen],
                linestyle="none",
                marker=marker,
                markersize=size,
                color=color,
                markerfacecolor="white" if hollow else color,
                zorder=3,
            )


# --- axes ---------------------------------------------------------------------------------------


def log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten within limits, and with 2 and 5 between them where that leaves fewer than 3."""
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    for steps in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)):
        ticks = [step * 10.0**n for n in decades for step in steps]
        inside = [tick for tick in ticks if low <= tick <= high]
        if len(inside) >= 3:
            return inside
    return inside


def log_axis(
    axes: Axes,
    name: Literal["x", "y"],
    values: Sequence[float],
    *,
    unit: str = "",
    ticks: Sequence[float] = (),
) -> None:
    """Make an axis logarithmic around some positive values.

    Parameters
    ----------
    axes : Axes
        A panel.
    name : str
        Which of its axes.
    values : sequence of float
        What must be seen.
    unit : str
        ``us``: ticks are written in us, ms or s. Else counts, with k, M and G.
    ticks : sequence of float
        Where ticks stand; none: at round numbers.
    """
    low, high = min(values, default=1.0) / 1.25, max(values, default=10.0) * 1.25
    if high / low < 4:
        middle = float(np.sqrt(low * high))
        low, high = middle / 2, middle * 2
    if name == "x":
        axes.set(xscale="log", xlim=(low, high))
    else:
        axes.set(yscale="log", ylim=(low, high))
    ticks = ticks or log_ticks(low, high)
    labels = [duration(tick) if unit == "us" else count(tick) for tick in ticks]
    fix_ticks(axes.xaxis if name == "x" else axes.yaxis, ticks, labels)
    axes.grid(visible=True, axis=name, color=RULE, linewidth=0.7)


def fix_ticks(axis: Axis, ticks: Sequence[float], labels: Sequence[str]) -> None:
    """Put named ticks at places, and none between them."""
    axis.set_major_locator(FixedLocator(list(ticks)))
    axis.set_major_formatter(FixedFormatter(list(labels)))
    axis.set_minor_locator(NullLocator())


def duration(us: float) -> str:
    """Microseconds in the unit that needs the fewest digits."""
    for size, unit in ((1e6, "s"), (1e3, "ms")):
        if us >= size * 0.9999:
            return f"{us / size:g} {unit}"
    return f"{us:g} us"


def count(value: float) -> str:
    """Three digits of a number, in thousands, millions or thousand millions."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= size * 0.9999:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"


def category_axis(axes: Axes, labels: Sequence[str], *, is_labelled: bool) -> None:
    """Number the y axis by names, the first on top."""
    axes.set_ylim(len(labels) - 0.4, -0.6)
    fix_ticks(axes.yaxis, range(len(labels)), labels if is_labelled else [""] * len(labels))
    axes.tick_params(axis="y", length=0)
