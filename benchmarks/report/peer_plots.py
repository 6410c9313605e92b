"""hapticdb beside other systems, and over the environment's size, as plots."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hapticdb.bench.cells import FRAME_US, Cell, distinct, frame_us, grouped, number, word
from hapticdb.bench.drawing.canvas import (
    BLUE,
    ENGINE_COLORS,
    FAINT,
    GREY,
    INK,
    MARKERS,
    RED,
    RULE,
    Stroke,
    category_axis,
    entry,
    head,
    lay_out,
    log_axis,
    not_measured,
)
from hapticdb.bench.drawing.panels import (
    TYPICAL,
    along,
    framing_of,
    line,
    look_of,
    mark_millisecond,
    millisecond_entry,
    strategy_entries,
    times,
)
from hapticdb.bench.drawing.plots import POSES, Plot
from hapticdb.bench.drawing.strategy_plots import whisker
from report.findings import OURS, asks_the_same, is_ours

PEER_LOOKS = {
    "ours": (RED, "D", "hapticdb"),
    "same": (BLUE, "o", "a peer that answers the same question"),
    "another": (GREY, "s", "a peer that answers another question"),
}
STROKES: tuple[Stroke, ...] = ("-", "--", ":")


def _look(cell: Cell) -> str:
    if is_ours(cell):
        return "ours"
    return "same" if asks_the_same(cell) else "another"


def draw_peers(plot: Plot) -> Figure:
    """All systems by half of their frames, the fastest on top."""
    cells = sorted(plot.cells, key=lambda cell: frame_us(cell, "p50") or 0.0)
    legend = [
        entry(label, color, marker=marker)
        for look, (color, marker, label) in PEER_LOOKS.items()
        if any(_look(cell) == look for cell in cells)
    ]
    legend += [entry("up to p99", INK, line="-", marker="|")]
    longest = max(len(word(cell, "peer")) for cell in cells)
    framing = framing_of(
        plot,
        [*legend, millisecond_entry()],
        ["Mark: half of the frames (p50)."],
        height=0.27 * len(cells) + 0.2,
        left=min(4.0, 0.3 + 0.078 * longest),
        above=0.12,
    )
    axes = lay_out(framing).panels[0][0]
    for y, cell in enumerate(cells):
        color, marker, _ = PEER_LOOKS[_look(cell)]
        whisker(axes, cell, y, color, marker)
    category_axis(axes, [word(cell, "peer") for cell in cells], is_labelled=True)
    for label, cell in zip(axes.get_yticklabels(), cells, strict=True):
        label.set_fontweight("bold" if is_ours(cell) else "normal")
    mark_millisecond(axes, "x")
    log_axis(axes, "x", [*times(cells, "p50", "p99"), FRAME_US], unit="us")
    axes.set_xlabel("time a frame")
    return _figure(axes)


def _figure(axes: Axes) -> Figure:
    figure = axes.get_figure(root=True)
    assert figure is not None
    return figure


def draw_voxelizing(plot: Plot) -> Figure:
    """Object voxels a second, the fastest on top."""
    cells = sorted(plot.cells, key=lambda cell: -(number(cell, "voxels_per_second") or 0.0))
    names = [_tool(cell, cells) for cell in cells]
    left = min(4.0, 0.3 + 0.078 * max(len(name) for name in names))
    framing = framing_of(plot, height=0.34 * len(cells) + 0.2, left=left, right=0.6, above=0.12)
    axes = lay_out(framing).panels[0][0]
    speeds = [(number(cell, "voxels_per_second") or 0.0) / 1e6 for cell in cells]
    colors = [RED if word(cell, "tool").startswith(OURS) else GREY for cell in cells]
    axes.barh(range(len(cells)), speeds, color=colors, height=0.62)
    for y, speed in enumerate(speeds):
        axes.annotate(f"{speed:.3g}", (speed, y), (4, 0), textcoords="offset points", va="center")
    category_axis(axes, names, is_labelled=True)
    axes.set_xlim(0, max(speeds) * 1.02)
    axes.set_xlabel("million object voxels a second")
    return _figure(axes)


def _tool(cell: Cell, among: Sequence[Cell]) -> str:
    """Name of a tool, with its parts where they differ."""
    known = number(cell, "parts")
    differ = len({number(other, "parts") for other in among}) > 1
    return word(cell, "tool") + (f", {known:,.0f} parts" if differ and known is not None else "")


def draw_scale(plot: Plot) -> Figure:
    """Time a frame for each engine, and storage, against the number of object voxels."""
    engines = distinct(plot.cells, "engine") or [None]
    strategies = distinct(plot.cells, "strategy")
    poses = distinct(plot.cells, "poses")
    strokes = {None: STROKES[0], **dict(zip(poses, STROKES * 9, strict=False))}
    legend = [*strategy_entries(strategies, "-")]
    legend += [entry(POSES.get(p, str(p)), FAINT, line=strokes[p]) for p in poses]
    framing = framing_of(plot, [*legend, millisecond_entry()], [TYPICAL], height=2.5, right=0.6)
    canvas = lay_out(framing, 1, len(engines) + 1)
    sizes = [float(n) for n in distinct(plot.cells, "object_voxels")]
    for column, (axes, engine) in enumerate(zip(canvas.panels[0], engines, strict=False)):
        head(axes, str(engine or ""))
        cells = [cell for cell in plot.cells if cell.get("engine") == engine]
        for (strategy, pose), own in grouped(cells, ("strategy", "poses")).items():
            color, marker = look_of(strategy)
            line(axes, along(own, "object_voxels"), color, stroke=strokes[pose], marker=marker)
        mark_millisecond(axes, "y")
        log_axis(axes, "y", [*times(plot.cells), FRAME_US], unit="us")
        if column == 0:
            axes.set_ylabel("time a frame")
        else:
            axes.tick_params(axis="y", labelleft=False)
    _draw_storage(canvas.panels[0][-1], plot.cells, engines)
    for axes in canvas.every:
        log_axis(axes, "x", sizes, ticks=sizes if len(sizes) <= 5 else ())
        axes.set_xlabel("object voxels")
    return canvas.figure


def _draw_storage(axes: Axes, cells: Sequence[Cell], engines: Sequence[str | None]) -> None:
    """Bytes a voxel, a line for each engine, named below the lines."""
    head(axes, "bytes an object voxel")
    axes.yaxis.tick_right()
    axes.spines["right"].set_visible(True)
    axes.spines["left"].set_visible(False)
    most = 0.0
    for engine, color, marker in zip(engines, ENGINE_COLORS, MARKERS, strict=False):
        places = sorted(
            {
                (voxels, size, False)
                for cell in cells
                if cell.get("engine") == engine
                and (voxels := number(cell, "object_voxels")) is not None
                and (size := number(cell, "bytes_per_voxel")) is not None
            }
        )
        if places:
            line(axes, places, color, marker=marker)
            axes.plot([], [], color=color, marker=marker, label=str(engine or ""))
            most = max(most, *(size for _, size, _ in places))
    if not most:
        not_measured(axes)
        return
    axes.set_ylim(0, most * 1.15)
    axes.grid(visible=True, axis="y", color=RULE, linewidth=0.7)
    axes.legend(loc="lower left", frameon=False, handlelength=1.4, borderaxespad=0.2)
