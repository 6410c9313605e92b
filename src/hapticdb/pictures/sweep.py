"""The picture of a sweep: the tool's path through the voxels, its hits, the clearance along it."""

import textwrap
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.pictures.demo import (
    BODY,
    COLORS,
    FAINT,
    INK,
    PAPER,
    SAMPLES,
    SCENE,
    SIZE,
    TOWARDS,
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
from hapticdb.sweeps.result import Moment, Swept
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
MOST_TOUCHED = 300
"""Samples whose hits are shown."""
LIFTS = (-9.0, 12.0, -26.0, 28.0, -44.0, 46.0)
BESIDE: list[tuple[float, float, Literal["left", "right"]]] = [
    *((9.0, lift, "left") for lift in LIFTS),
    *((-9.0, lift, "right") for lift in LIFTS),
]
"""Where the words of a mark may stand: typographic points to the right and up, and the end of the
words that stands there."""
WAY = 400
"""Samples of the path that are drawn at most. More follow a curved path better."""
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
    """Lay out the figure of a sweep: words, the scene, the clearance along the path.

    env, shell, exclude : what was swept; excluded objects are not drawn; found : with its profile
    of clearances; verdict : one line of words; up : axis that points up, x, y or z; what most of
    the objects' files say unless given.
    """
    left_out = set(exclude)
    figure, above = new_figure()
    colors = dict(zip((one.object.id for one in found.objects), COLORS, strict=False))
    legend = _draw_legend(figure, found, colors)
    _write_verdict(figure, verdict, _words(env, shell, found))
    axis = up_axis(env.objects()) if up is None else AXES.index(up)
    camera = _camera(env, shell, found, left_out, axis, legend)
    _draw_scene(above, env, camera, colors, left_out)
    _draw_tool(above, camera, shell, found)
    _draw_hits(above, camera, env, shell, found, colors, left_out)
    _draw_way(above, camera, shell, found)
    _draw_profile(figure, found)
    return figure


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


def _words(env: Environment, shell: PointShell, found: Swept) -> str:
    return (
        f"{len(shell):,} points, {found.samples:,} samples along {len(found.path.poses):,} poses, "
        f"voxels of {length_text(env.grid.voxel_size)}"
    )


def _placed(points: Floats, pose: Floats) -> Floats:
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _some_samples(found: Swept, count: int) -> NDArray[np.int64]:
    """Samples, at most so many, evenly along the path."""
    count = min(count, found.samples)
    return np.unique(np.linspace(0, found.samples - 1, count).round().astype(np.int64))


def _poses_at(found: Swept, samples: NDArray[np.int64]) -> Floats:
    """Poses (n, 4, 4) of samples (n,)."""
    return np.concatenate([found.path.sample(n, n + 1) for n in samples.tolist()])


def _camera(
    env: Environment, shell: PointShell, found: Swept, exclude: set[int], up: int, legend: float
) -> Camera:
    """Camera that has the tool's way in view, left of the legend, and the scene or some of it."""
    low, high = shell.points.min(axis=0), shell.points.max(axis=0)
    which = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    corners = np.stack([low, high])[which, np.arange(3)]
    poses = _poses_at(found, _some_samples(found, WAY))
    swept = np.stack([_placed(corners, pose) for pose in poses])
    low, high = swept.min(axis=1), swept.max(axis=1)
    length = float((high.max(axis=0) - low.min(axis=0)).max())
    boxes = np.stack([low - ROOM * length, high + ROOM * length], axis=1)
    felt = [obj.bounds for obj in env.objects() if obj.id not in exclude]
    everything = np.concatenate([boxes, np.array(felt).reshape(-1, 2, 3)])
    extent = float((everything[:, 1].max(axis=0) - everything[:, 0].min(axis=0)).max())
    window = SAMPLES * np.array(WINDOW, dtype=np.float64)
    window[1, 0] = min(window[1, 0], SAMPLES * (legend - LINE))
    return Camera.looking_at(
        everything if extent <= CLOSE_UP * length else boxes,
        np.array(TOWARDS),
        (SCENE[0] * SAMPLES, SCENE[1] * SAMPLES),
        window,
        up,
    )


def _draw_scene(
    axes: Axes, env: Environment, camera: Camera, colors: dict[int, str], exclude: set[int]
) -> None:
    """Shade the voxels in view, objects that are hit in their colours."""
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
    which = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    for obj in sorted(env.objects(), key=lambda obj: (obj.voxels, obj.id)):
        seen = camera.project(obj.bounds[which, np.arange(3)])
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
    samples = _some_samples(found, GHOSTS)
    for sample, pose in zip(samples.tolist(), _poses_at(found, samples), strict=True):
        seen = camera.project(_placed(points, pose)) / SAMPLES
        is_end = sample in {0, found.samples - 1}
        axes.scatter(
            seen[:, 0], seen[:, 1], s=3.0, c=INK, linewidths=0, alpha=0.8 if is_end else 0.3
        )


def _draw_way(axes: Axes, camera: Camera, shell: PointShell, found: Swept) -> None:
    """Way of the tool's middle, other where it hits something; start, and what matters on it."""
    middle = 0.5 * (shell.points.min(axis=0) + shell.points.max(axis=0))[None]
    samples = _some_samples(found, WAY)
    places = np.concatenate([_placed(middle, pose) for pose in _poses_at(found, samples)])
    seen = camera.project(places)[:, :2] / SAMPLES
    fractions = found.path.fractions(samples)
    segments = np.stack([seen[:-1], seen[1:]], axis=1)
    halfway = 0.5 * (fractions[:-1] + fractions[1:])
    low, high = found.hit_intervals[:, :1], found.hit_intervals[:, 1:]
    is_hit = np.any((halfway >= low) & (halfway <= high), axis=0)
    for width, alpha, colors in (
        (4.5, 0.6, [PAPER] * len(segments)),
        (2.0, 1.0, [CAUGHT if caught else FREE for caught in is_hit.tolist()]),
    ):
        axes.add_collection(
            LineCollection(segments.tolist(), colors=colors, linewidths=width, alpha=alpha)
        )
    first_contact = found.caught or found.first_contact
    if first_contact is None or first_contact.sample > 0:
        _mark(axes, seen[0], "start", FREE)
    if found.samples > 1:
        _mark(axes, seen[-1], "end", FREE)
    clearance = found.clearance
    if first_contact is not None:
        _mark(axes, _middle_at(camera, middle, first_contact), "first contact", CAUGHT)
    elif clearance is not None and clearance.point is not None:
        at = camera.project(clearance.point[None])[0, :2] / SAMPLES
        _mark(axes, at, f"nearest: {length_text(clearance.distance)}", COLORS[1])


def _middle_at(camera: Camera, middle: Floats, moment: Moment) -> Floats:
    return np.asarray(camera.project(_placed(middle, moment.pose))[0, :2] / SAMPLES)


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


def _draw_hits(
    axes: Axes,
    camera: Camera,
    env: Environment,
    shell: PointShell,
    found: Swept,
    colors: dict[int, str],
    exclude: set[int],
) -> None:
    """Hits of some samples as points in the colour of their object."""
    samples = np.arange(found.samples) if found.samples < WAY else _some_samples(found, 20 * WAY)
    at = found.path.fractions(samples)
    low, high = found.hit_intervals[:, :1], found.hit_intervals[:, 1:]
    samples = samples[np.any((at >= low) & (at <= high), axis=0)]
    samples = samples[:: max(1, len(samples) // MOST_TOUCHED)]
    if not len(samples):
        return
    for pose in _poses_at(found, samples):
        pairs = env.touch(shell, pose, exclude=exclude, law="plane").pairs
        seen = camera.project(_placed(shell.points[pairs[:, 0]], pose)) / SAMPLES
        tints = [colors.get(i, FAINT) for i in pairs[:, 1].tolist()]
        axes.scatter(seen[:, 0], seen[:, 1], s=5.0, c=tints, linewidths=0, alpha=0.8, zorder=4)


def _draw_legend(figure: Figure, found: Swept, colors: dict[int, str]) -> float:
    """Names of the objects that are hit, in their colours; pixels from the left where they begin.

    Where nothing is hit, that is the right edge of the words.
    """
    names = {one.object.id: one.object.name for one in found.objects}
    lines = [(shortened(names[i], LEGEND), color) for i, color in colors.items()]
    if len(names) > len(colors):
        lines.append((f"and {len(names) - len(colors)} more", FAINT))
    begins = float(RIGHT + LEFT)
    for number, (words, color) in enumerate(lines):
        x, y = RIGHT / SIZE[0], 1.0 - (TOP + LINE * number) / SIZE[1]
        text = figure.text(
            x, y, words, color=color, fontsize=12, ha="right", va="center", bbox=BEHIND
        )
        begins = min(begins, float(extent_of(text).x0))
    return begins


def _draw_profile(figure: Figure, found: Swept) -> None:
    """Clearance and points hit along the path."""
    profile = found.profile
    share = 100 * np.append(profile.fractions, 1.0)
    top = figure.add_axes((0.055, 0.165, 0.925, 0.085))
    farthest = float(np.nanmax(profile.clearances, initial=0.0)) or found.voxel_size
    size, unit = readable_unit(farthest)
    near = np.append(profile.clearances, profile.clearances[-1:]) / size
    top.step(share, near, where="post", color=COLORS[1], linewidth=1.2)
    if found.clearance is not None and np.isfinite(near).all():
        top.fill_between(share, 0, near, step="post", color=COLORS[1], alpha=0.2, linewidth=0)
        top.set_ylim(0, 1.08 * farthest / size)
    bottom = figure.add_axes((0.055, 0.06, 0.925, 0.085))
    hits = np.append(profile.hits, profile.hits[-1:])
    bottom.fill_between(share, 0, hits, step="post", color=CAUGHT, alpha=0.75, linewidth=0)
    bottom.set_ylim(0, 1.08 * max(int(hits.max(initial=0)), 1))
    bottom.yaxis.set_major_locator(MaxNLocator(3, integer=True))
    bottom.set_xlabel("per cent of the path", color=FAINT, fontsize=11, labelpad=1)
    for axes, label in ((top, f"clear, {unit}"), (bottom, "points hit")):
        style(axes, 9)
        axes.set_xlim(0, 100)
        axes.set_ylabel(label, color=FAINT, fontsize=10)
    top.tick_params(labelbottom=False)
