"""The plots of the feel: a panel for each law, and the picture of the walk."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hapticdb.bench.drawing.canvas import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    RULE,
    SKY,
    Framing,
    entry,
    fix_ticks,
    head,
    lay_out,
    log_ticks,
    not_measured,
    styled,
    write,
)
from hapticdb.environment import open as open_environment
from hapticdb.errors import FileError
from hapticdb.pictures.splat import Camera, Depths, shade, splat

if TYPE_CHECKING:
    from hapticdb.bench.feel.walking import Walk

COLORS = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY)
LAWS = (("plane", "tangent plane"), ("smooth", "distance law"))
"""Panels of a plot: each law, and its title."""
WALK_PICTURE = "walk.png"
"""File of the walk's picture."""
SIZE = (1100, 560)
"""Pixels of that picture."""
MARGIN = 30
"""Pixels around the model in it."""
TOWARDS = (0.50, 0.76, 0.44)
"""Direction from the model to the eye: ahead, to the left, above."""
PAPER, BODY, WAY = np.array([1.0, 1.0, 1.0]), np.array([0.55, 0.60, 0.66]), RED
"""Colours of the picture: behind the model, the model, and the path."""


@dataclass(frozen=True)
class FeelPlot:
    """A plot: its file's name, whose curves it has, title, names of its axes, logarithmic or not.

    is_shared : whether both panels have the same heights.
    """

    name: str
    curve: str
    title: str
    x: str
    y: str
    is_log: bool = False
    is_shared: bool = True


PLOTS: Sequence[FeelPlot] = (
    FeelPlot(
        "depth",
        "depth",
        "Force of touch against depth, 9 points",
        "depth below the onset of contact, voxels",
        "normal force, N",
    ),
    FeelPlot(
        "slide",
        "slide",
        "Force of touch on a slide at constant depth",
        "way, mm",
        "normal force, N",
    ),
    FeelPlot(
        "press",
        "press",
        "Force of a session against the hand's depth, k = 1000 N/m",
        "depth below the onset of contact, mm",
        "normal force, N",
    ),
    FeelPlot(
        "edge",
        "edge",
        "Force of a session round a convex edge, hand 2 mm deep",
        "way of the hand, mm",
        "force, N",
    ),
    FeelPlot(
        "tap",
        "tap",
        "A tap at 0.3 m/s with a firm grip",
        "time, s",
        "normal force, N",
    ),
    FeelPlot("walk", "walk", "A walk over a model", "time, s", "force, N", is_shared=False),
    FeelPlot(
        "spectrum",
        "spectrum",
        "Spectrum of the force on that walk",
        "frequency, Hz",
        "amplitude, N",
        is_log=True,
    ),
)
"""The plots, in the order of the page."""
IN_MM = {"press", "edge"}
"""Plots whose curves are in metres along x."""


def draw_feel(result: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw every plot that a result has curves for; returns the SVG files."""
    paths = []
    with styled():
        for plot in PLOTS:
            curves = [curve for curve in result["curves"] if curve["curve"] == plot.curve]
            if curves:
                path = folder / f"{plot.name}.svg"
                write(paint(plot, curves), path)
                paths.append(path)
    return paths


def paint(plot: FeelPlot, curves: Sequence[Mapping[str, Any]]) -> Figure:
    """One plot: a panel for each law."""
    labels = list(dict.fromkeys(str(curve["label"]) for curve in curves))
    colors = {label: COLORS[n % len(COLORS)] for n, label in enumerate(labels)}
    legend = [entry(label, colors[label], line="-") for label in labels]
    between = 0.2 if plot.is_shared else 0.7
    canvas = lay_out(Framing(plot.title, legend=legend, height=2.4, between=between), 1, len(LAWS))
    for axes, (law, name) in zip(canvas.every, LAWS, strict=True):
        head(axes, name)
        own = [curve for curve in curves if curve["law"] == law]
        if not own:
            not_measured(axes)
        for curve in own:
            _line(axes, plot, curve, colors[str(curve["label"])])
        axes.set_xlabel(plot.x)
        axes.grid(visible=True, color=RULE, linewidth=0.7)
    left, *others = canvas.every
    left.set_ylabel(plot.y)
    if plot.is_shared:
        _share_heights(canvas.every, plot)
        for axes in others:
            axes.tick_params(axis="y", labelleft=False)
    return canvas.figure


def _line(axes: Axes, plot: FeelPlot, curve: Mapping[str, Any], color: str) -> None:
    x, y = np.array(curve["x"]), np.array(curve["y"])
    x = 1e3 * x if plot.name in IN_MM else x
    if plot.is_log:
        x, y = x[1:], np.maximum(y[1:], 1e-7)
    axes.plot(x, y, color=color, linewidth=1.1)
    if plot.is_log:
        axes.set(xscale="log", yscale="log")


def _share_heights(panels: Sequence[Axes], plot: FeelPlot) -> None:
    limits = np.array([axes.get_ylim() for axes in panels if axes.lines])
    low, high = float(limits[:, 0].min()), float(limits[:, 1].max())
    for axes in panels:
        axes.set_ylim(low, high)
        if plot.is_log and axes.lines:
            # plain numbers: the style draws no mathematics, in which powers are written otherwise
            for axis, ends in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, (low, high))):
                ticks = log_ticks(*ends)
                fix_ticks(axis, ticks, [f"{tick:g}" for tick in ticks])


# --- the picture of the walk ----------------------------------------------------------------------


def draw_walk(walk: "Walk", url: str | Path, folder: Path) -> Path:
    """Draw the model and the hand's way over it, as a PNG; the model's z axis points up."""
    width, height = SIZE
    with open_environment(url, read_only=True) as env:
        objects = env.objects()
        boxes = np.array([obj.bounds for obj in objects])
        window = np.array([[MARGIN, MARGIN], [width - MARGIN, height - MARGIN]], dtype=np.float64)
        camera = Camera.looking_at(boxes, np.array(TOWARDS), SIZE, window)
        depths = Depths.empty(camera)
        size = env.grid.voxel_size
        for obj in objects:
            splat(depths, camera, env.grid.centers(env.voxels(obj.id)), size, 0)
        picture = shade(depths, camera, BODY[None], PAPER, size)
    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(np.clip(picture, 0.0, 1.0), interpolation="none", aspect="auto")
    seen = camera.project(walk.hand)
    axes.plot(seen[:, 0], seen[:, 1], color=WAY, linewidth=1.6)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.axis("off")
    path = folder / WALK_PICTURE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=100)
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error
    return path
