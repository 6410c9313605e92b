"""The picture of a sweep: the tool's path through the scene, what it hits, the gap along it."""

import textwrap
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.grid import corners_of
from hapticdb.pictures.demo import (
    BODY,
    COLORS,
    FAINT,
    INK,
    PAPER,
    SAMPLES,
    SCENE,
    SIZE,
    camera_of,
    mixed,
    new_figure,
    shortened,
    show_scene,
    style,
)
from hapticdb.pictures.splat import Camera, empty_depths, faded, shade, splat
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.attributes import AXES, up_axis
from hapticdb.store.base import Object
from hapticdb.sweeps.result import Profile, Swept
from hapticdb.units import length_text, readable_unit

WINDOW = ((60, 105), (1540, 690))
"""Corners of the part of the scene that the path and its surroundings fill, pixels."""
CLOSE_UP = 3.0
"""The whole scene is shown up to so many lengths of the path; of a larger one, the surroundings."""
FADE = 90
"""Pixels from the edges within which a scene fades that continues beyond them."""
LEFT, RIGHT, TOP, LINE = 35, 1565, 45, 24
"""Places of the words, pixels from the upper left corner; LINE: from one name to the next."""
LEGEND = 38
"""Letters that the name of an object takes at most."""
VERDICT = {17: 80, 13: 104}
"""Letters of a line of the verdict, by the size of its font."""
ROOM = 0.1
"""Room around the tool at each pose, as a share of the whole path's extent."""
MOST_VOXELS = 30_000_000
"""Voxels drawn at most; the largest objects are left out first."""
GHOSTS = 7
"""Poses at which the tool is shown."""
GHOST_POINTS = 1500
"""Points of the shell drawn at each of these poses, at most about twice as many."""
LIFTS = (-9.0, 12.0, -26.0, 28.0, -44.0, 46.0)
BESIDE: list[tuple[float, float, Literal["left", "right"]]] = [
    *((9.0, lift, "left") for lift in LIFTS),
    *((-9.0, lift, "right") for lift in LIFTS),
]
"""Where the words of a mark may stand: typographic points to the right and up, and the end of the
words that stands there."""
WAY = 400
"""Places of the path that are drawn. More follow a curved path better."""
FREE, CAUGHT = "#ffffff", "#ff5d73"
BEHIND = {"facecolor": PAPER, "alpha": 0.55, "linewidth": 0, "pad": 1.5}
"""What is behind words, so that they are readable over the scene."""

Floats = NDArray[np.float64]


def compose_sweep(
    env: Environment,
    shell: PointShell,
    found: Swept,
    *,
    exclude: Iterable[int] = (),
    verdict: str = "",
    up: str | None = None,
) -> Figure:
    """Lay out the figure of a sweep: words, the scene, the gap along the path.

    env, shell, exclude : what was swept; excluded objects are not drawn; found : the gap along the
    path is drawn if it has a profile; verdict : one line of words; up : axis that points up, x, y
    or z; what most of the objects' files say unless given.
    """
    left_out = set(exclude)
    figure, above = new_figure()
    shown = _shown_objects(found)
    colors = dict(zip((obj.id for obj in shown), COLORS, strict=False))
    legend = _draw_legend(figure, shown, colors)
    _write_verdict(figure, verdict, _words(shell, found))
    axis = up_axis(env.objects()) if up is None else AXES.index(up)
    camera = _camera(env, shell, found, left_out, axis, legend)
    _draw_scene(above, env, camera, colors, left_out)
    _draw_tool(above, camera, shell, found)
    _draw_hits(above, camera, found, colors)
    _draw_way(above, camera, shell, found)
    _draw_gap(figure, found)
    return figure


def _shown_objects(found: Swept) -> list[Object]:
    """What is hit, in the order along the path, encloses or is touched; else what is nearest."""
    met = [place.object for place in found.hits]
    met += [*found.enclosed, *(one.object for one in found.touching)]
    if not met and found.gap.place is not None:
        met = [found.gap.place.object]
    return list({obj.id: obj for obj in met}.values())


def _write_verdict(figure: Figure, verdict: str, words: str) -> None:
    """Write the verdict, a long one smaller and in lines; below it what was swept."""
    size = 17 if len(verdict) <= VERDICT[17] else 13
    lines = textwrap.wrap(verdict, VERDICT[size], max_lines=3, placeholder="…")
    down = TOP - 10 * (len(lines) > 1)
    for line in lines:
        _write(figure, down, line, color="white", fontsize=size)
        down += LINE
    _write(figure, down + 6, words, color=FAINT, fontsize=12)


def _write(figure: Figure, down: float, words: str, **style: Any) -> None:  # noqa: ANN401 - matplotlib's
    """Write a line at the left, so many pixels from the top, readable over the scene."""
    figure.text(LEFT / SIZE[0], 1.0 - down / SIZE[1], words, va="center", bbox=BEHIND, **style)


def _words(shell: PointShell, found: Swept) -> str:
    length = length_text(float(np.linalg.norm(np.ptp(shell.outline, axis=0))))
    near = f"{found.objects:,} object{'s' * (found.objects != 1)} near it"
    way = length_text(found.path.length)
    return f"{length} across, {way} along {len(found.path.poses):,} poses, {near}"


def _placed(points: Floats, pose: Floats) -> Floats:
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _along(found: Swept, count: int) -> tuple[Floats, Floats]:
    """Fractions (n,) and poses (n, 4, 4), at most so many, evenly along the path."""
    fractions = np.linspace(0.0, 1.0, count if found.path.length > 0.0 else 1)
    return fractions, found.path.at(fractions * found.path.length)


def _camera(
    env: Environment, shell: PointShell, found: Swept, exclude: set[int], up: int, legend: float
) -> Camera:
    """Camera that has the tool's way in view, left of the legend, and the scene or some of it."""
    low, high = shell.points.min(axis=0), shell.points.max(axis=0)
    corners = corners_of(np.stack([low, high]))
    swept = np.stack([_placed(corners, pose) for pose in _along(found, WAY)[1]])
    low, high = swept.min(axis=1), swept.max(axis=1)
    length = float((high.max(axis=0) - low.min(axis=0)).max())
    boxes = np.stack([low - ROOM * length, high + ROOM * length], axis=1)
    felt = [obj.bounds for obj in env.objects() if obj.id not in exclude]
    everything = np.concatenate([boxes, np.array(felt).reshape(-1, 2, 3)])
    extent = float((everything[:, 1].max(axis=0) - everything[:, 0].min(axis=0)).max())
    (left, top), (right, bottom) = WINDOW
    window = (left, top), (min(right, legend - LINE), bottom)
    return camera_of(everything if extent <= CLOSE_UP * length else boxes, window, up)


def _draw_scene(
    axes: Axes, env: Environment, camera: Camera, colors: dict[int, str], exclude: set[int]
) -> None:
    """Shade the voxels in view, objects that the legend names in their colours."""
    depths = empty_depths(camera)
    tints = [mixed(BODY, BODY, 0.0)]
    for obj in _in_view(env, camera, exclude):
        centers = env.grid.centers(env.voxels(obj.id))
        ahead = (centers - camera.eye) @ camera.axes[2]
        near = centers[(ahead > camera.near) & (ahead < camera.far)]
        if len(near):
            splat(depths, camera, near, env.grid.voxel_size, len(tints))
            tints.append(mixed(BODY, colors.get(obj.id, BODY), 0.4))
    paper = np.array(mixed(PAPER, PAPER, 0.0))
    image = shade(depths, camera, np.array(tints), paper, env.grid.voxel_size)
    image = faded(image, camera, paper, FADE * SAMPLES)
    show_scene(axes, image)


def _in_view(env: Environment, camera: Camera, exclude: set[int]) -> list[Object]:
    """Objects whose bounds may be seen, the smallest first, while they are not too many voxels."""
    chosen: list[Object] = []
    total = 0
    for obj in sorted(env.objects(), key=lambda obj: (obj.voxels, obj.id)):
        seen = camera.project(corners_of(obj.bounds))
        is_begun = (seen.max(axis=0) > (0, 0, camera.near)).all()
        is_ended = (seen.min(axis=0) >= (*camera.size, camera.far)).any()
        if obj.id not in exclude and is_begun and not is_ended:
            total += obj.voxels
            if total > MOST_VOXELS:
                break
            chosen.append(obj)
    return chosen


def _draw_tool(axes: Axes, camera: Camera, shell: PointShell, found: Swept) -> None:
    """Shell at a few poses, the first and the last brightest."""
    points = shell.points[:: max(1, len(shell) // GHOST_POINTS)]
    for fraction, pose in zip(*_along(found, GHOSTS), strict=True):
        seen = camera.project(_placed(points, pose)) / SAMPLES
        alpha = 0.8 if fraction in {0.0, 1.0} else 0.3
        axes.scatter(seen[:, 0], seen[:, 1], s=3.0, c=INK, linewidths=0, alpha=alpha)


def _draw_way(axes: Axes, camera: Camera, shell: PointShell, found: Swept) -> None:
    """Way of the tool's middle, other from its first hit on; start, and what matters on it."""
    middle = 0.5 * (shell.points.min(axis=0) + shell.points.max(axis=0))[None]
    fractions, poses = _along(found, WAY)
    places = np.concatenate([_placed(middle, pose) for pose in poses])
    seen = camera.project(places)[:, :2] / SAMPLES
    segments = np.stack([seen[:-1], seen[1:]], axis=1)
    first = found.hits[0] if found.hits else None
    until = np.inf if first is None else first.fraction
    is_past = 0.5 * (fractions[:-1] + fractions[1:]) >= until
    for width, alpha, colors in (
        (4.5, 0.6, [PAPER] * len(segments)),
        (2.0, 1.0, [CAUGHT if past else FREE for past in is_past.tolist()]),
    ):
        axes.add_collection(
            LineCollection(segments.tolist(), colors=colors, linewidths=width, alpha=alpha)
        )
    if until > 0.0:
        _mark(axes, seen[0], "start", FREE)
    if len(fractions) > 1:
        _mark(axes, seen[-1], "end", FREE)
    nearest = found.gap.place
    if first is not None:
        _mark(axes, _seen(camera, first.on_object), "first hit", CAUGHT)
    elif nearest is not None:
        words = f"nearest: {length_text(found.gap.at_least)}"
        _mark(axes, _seen(camera, nearest.on_object), words, COLORS[1])


def _seen(camera: Camera, place: Floats) -> Floats:
    """Where a place (3,) is in the picture."""
    return np.asarray(camera.project(place[None])[0, :2] / SAMPLES)


def extent_of(text: Text) -> Bbox:
    """Box of a text as it is drawn, pixels from the lower left corner."""
    figure = text.get_figure(root=True)
    assert figure is not None  # noqa: S101 - it was drawn on one
    assert isinstance(figure.canvas, FigureCanvasAgg)  # noqa: S101 - of `new_figure`
    return text.get_window_extent(figure.canvas.get_renderer())  # type: ignore[no-untyped-call]


def _mark(axes: Axes, at: Floats, text: str, color: str) -> None:
    """Mark a place, its words beside it where they run over no others."""
    axes.scatter([at[0]], [at[1]], s=46, c=color, edgecolors=PAPER, linewidths=1.2, zorder=5)
    figure = axes.figure
    taken = [extent_of(other) for other in (*figure.texts, *axes.texts)]
    label = axes.annotate(
        text, (float(at[0]), float(at[1])), xytext=BESIDE[0][:2], textcoords="offset points",
        color=color, fontsize=11, zorder=6, bbox=BEHIND,
    )  # fmt: skip
    for right, lift, side in BESIDE:
        label.set_position((right, lift))
        label.set_horizontalalignment(side)
        box = extent_of(label)
        is_inside = box.x0 >= 0 and box.x1 <= SIZE[0] and box.y0 >= SIZE[1] - SCENE[1]
        if is_inside and not any(box.overlaps(other) for other in taken):
            return


def _draw_hits(axes: Axes, camera: Camera, found: Swept, colors: dict[int, str]) -> None:
    """The first place where each object is hit, in the object's colour."""
    for place in found.hits:
        at = _seen(camera, place.on_object)
        tint = colors.get(place.object.id, FAINT)
        axes.scatter([at[0]], [at[1]], s=30, c=tint, edgecolors=PAPER, linewidths=1.0, zorder=4)


def _draw_legend(figure: Figure, shown: list[Object], colors: dict[int, str]) -> float:
    """Names of objects in their colours; pixels from the left where they begin.

    Where none is shown, that is the right edge of the words.
    """
    lines = [(shortened(obj.name, LEGEND), colors[obj.id]) for obj in shown if obj.id in colors]
    if len(shown) > len(colors):
        lines.append((f"and {len(shown) - len(colors)} more", FAINT))
    begins = float(RIGHT + LEFT)
    for number, (words, color) in enumerate(lines):
        x, y = RIGHT / SIZE[0], 1.0 - (TOP + LINE * number) / SIZE[1]
        text = figure.text(
            x, y, words, color=color, fontsize=12, ha="right", va="center", bbox=BEHIND
        )
        begins = min(begins, float(extent_of(text).x0))
    return begins


def _draw_gap(figure: Figure, found: Swept) -> None:
    """The gap along the path; where something is hit or touched."""
    axes = figure.add_axes((0.055, 0.06, 0.925, 0.19))
    style(axes, 9)
    unit = "m" if found.profile is None else _draw_profile(axes, found.profile)
    for one in found.touching:
        axes.axvspan(0.0, 100.0 * one.until, color=COLORS[0], alpha=0.15, linewidth=0)
    for place in found.hits:
        axes.axvline(100.0 * place.fraction, color=CAUGHT, linewidth=1.2)
    axes.set_xlim(0, 100)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel(f"gap, {unit}", color=FAINT, fontsize=10)
    axes.set_xlabel("per cent of the path", color=FAINT, fontsize=11, labelpad=1)


def _draw_profile(axes: Axes, profile: Profile) -> str:
    """Draw the gap where it is known; returns the unit."""
    is_known = np.isfinite(profile.gaps)
    farthest = float(profile.gaps[is_known].max(initial=0.0))
    size, unit = readable_unit(farthest or 1.0)
    gaps = np.where(is_known, profile.gaps / size, np.nan)
    share = 100.0 * profile.fractions
    axes.plot(share, gaps, color=COLORS[1], linewidth=1.2)
    axes.fill_between(share, 0.0, gaps, color=COLORS[1], alpha=0.2, linewidth=0)
    return unit
