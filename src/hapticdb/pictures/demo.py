"""The picture of a demo: the environment's voxels, the path, the hits by object, the force."""

import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import FileError
from hapticdb.pictures.splat import Camera, Image, empty_depths, shade, splat
from hapticdb.store.attributes import up_axis

if TYPE_CHECKING:
    from hapticdb.demo import Comparison, DemoScene, Trace

SIZE = (1600, 1000)
"""Pixels of the picture; the scene fills the upper part."""
SCENE = (1600, 740)
WINDOW = ((170, 30), (1480, 712))
"""Corners of the part of the scene that the objects fill, pixels."""
SAMPLES = 2
"""Pixels drawn for each pixel shown, an axis. More make smoother edges and take longer."""
PAPER = "#0f1419"
INK = "#d7dde4"
FAINT = "#7d8896"
BODY = "#6f7b89"
REST = "#b9c2cc"
COLORS = ("#ffb000", "#35c6f4", "#ff5d73", "#7ee081", "#c792ff", "#ff8f4d")
"""Of the objects touched most, one each; all others have the colour `REST`."""
TOOLS_SHOWN = 9
"""Poses at which the tool is drawn."""
HITS_SHOWN = 30_000
"""Hits drawn at most, evenly along the path."""
LEGEND = 130
"""Letters that all names of objects may take together, in a line above the force."""
TOWARDS = (0.50, 0.76, 0.44)
"""Direction from the scene to the eye: ahead, to the left, above."""


@dataclass(frozen=True)
class _Palette:
    """Colours and names by object id, of the objects touched most; the most touched first."""

    colors: dict[int, str]
    names: dict[int, str]

    def of(self, object_id: int) -> str:
        return self.colors.get(object_id, REST)


def draw(path: Path, scene: "DemoScene", comparison: "Comparison") -> None:
    """Draw the first environment of a demo, what its tool felt, and write it as a PNG."""
    with open_environment(scene.imported[0].url, read_only=True) as env:
        save(_compose(env, scene, comparison), path)


def _compose(env: Environment, scene: "DemoScene", comparison: "Comparison") -> Figure:
    """Lay out the figure: the scene above, the force along the path below."""
    trace = comparison.trace
    palette = _palette(env, trace)
    figure, above = new_figure()
    objects = env.objects()
    boxes = np.array([obj.bounds for obj in objects])
    camera = camera_of(boxes, WINDOW, up_axis(objects))
    _draw_scene(above, env, camera, palette)
    _draw_path(above, camera, scene, trace, palette)
    _draw_words(figure, scene, comparison)
    below = figure.add_axes((0.055, 0.085, 0.925, 0.165))
    _draw_force(below, trace, palette)
    return figure


def new_figure() -> tuple[Figure, Axes]:
    """An empty picture, and the axes of the scene in its upper part."""
    figure = Figure(figsize=(SIZE[0] / 100, SIZE[1] / 100), dpi=100, facecolor=PAPER)
    FigureCanvasAgg(figure)
    return figure, figure.add_axes((0.0, 1 - SCENE[1] / SIZE[1], 1.0, SCENE[1] / SIZE[1]))


def shortened(words: str, most: int) -> str:
    """Words of at most `most` letters; the middle of longer ones is left out."""
    half = (most - 1) // 2
    return words if len(words) <= most else f"{words[:half].rstrip()}…{words[-half:].lstrip()}"


def _palette(env: Environment, trace: "Trace") -> _Palette:
    known = {obj.id: obj.name for obj in env.objects()}
    most = [i for i, _ in Counter(trace.ids.tolist()).most_common(len(COLORS))]
    names = {i: known[i].rsplit("/", 1)[-1].replace("_", " ") for i in most}
    return _Palette(dict(zip(most, COLORS, strict=False)), names)


def camera_of(boxes: NDArray[np.float64], window: ArrayLike, up: int) -> Camera:
    """Camera that has boxes (B, 2, 3), metres, in a window of the scene, pixels."""
    seen = SAMPLES * np.asarray(window, dtype=np.float64)
    size = (SCENE[0] * SAMPLES, SCENE[1] * SAMPLES)
    return Camera.looking_at(boxes, np.array(TOWARDS), size, seen, up)


def _draw_scene(axes: Axes, env: Environment, camera: Camera, palette: _Palette) -> None:
    """Shade the voxels as the database holds them, object by object."""
    depths = empty_depths(camera)
    tints = []
    for number, obj in enumerate(env.objects()):
        centers = env.grid.centers(env.voxels(obj.id))
        splat(depths, camera, centers, env.grid.voxel_size, number)
        tints.append(mixed(BODY, palette.of(obj.id), 0.24 if obj.id in palette.colors else 0.0))
    image = shade(depths, camera, np.array(tints), np.array(to_rgb(PAPER)), env.grid.voxel_size)
    show_scene(axes, image)


def show_scene(axes: Axes, image: Image) -> None:
    """Show the shaded scene, `SAMPLES` pixels of the image for each of the picture's, an axis."""
    small = image.reshape(SCENE[1], SAMPLES, SCENE[0], SAMPLES, 3).mean(axis=(1, 3))
    axes.imshow(np.clip(small, 0, 1), extent=(0, SCENE[0], SCENE[1], 0), interpolation="nearest")
    axes.set_xlim(0, SCENE[0])
    axes.set_ylim(SCENE[1], 0)
    axes.set_aspect("auto")
    axes.axis("off")


def style(axes: Axes, size: int) -> None:
    """Give a diagram below the scene its colours; size: of its numbers, points."""
    axes.set_facecolor(PAPER)
    axes.tick_params(colors=FAINT, labelsize=size, length=3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#39424d")


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a picture as a PNG; FileError when the file cannot be written."""
    try:
        figure.savefig(path, dpi=100, facecolor=PAPER, format="png")
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error


def mixed(one: str, other: str, share: float) -> tuple[float, float, float]:
    """Red, green and blue, 0 to 1, of one colour with a share of another."""
    r, g, b = (1 - share) * np.array(to_rgb(one)) + share * np.array(to_rgb(other))
    return float(r), float(g), float(b)


def _draw_path(
    axes: Axes, camera: Camera, scene: "DemoScene", trace: "Trace", palette: _Palette
) -> None:
    """Hits as points in the colour of their object, the tool at a few poses, and its path."""
    step = max(1, len(trace.points) // HITS_SHOWN)
    places = camera.project(trace.points[::step])[:, :2] / SAMPLES
    colors = [palette.of(i) for i in trace.ids[::step].tolist()]
    axes.scatter(places[:, 0], places[:, 1], s=1.6, c=colors, linewidths=0, alpha=0.55)
    triangles = _tool_triangles(scene)
    for index in np.linspace(0, len(scene.poses) - 1, TOOLS_SHOWN).astype(int):
        _draw_tool(axes, camera, triangles, scene.poses[index])
    way = camera.project(scene.poses[:, :3, 3])[:, :2] / SAMPLES
    segments = np.stack([way[:-1], way[1:]], axis=1)
    for color, width, alpha in ((PAPER, 3.4, 0.55), ("white", 1.3, 0.95)):
        axes.add_collection(
            LineCollection(segments.tolist(), colors=color, linewidths=width, alpha=alpha)
        )


def _tool_triangles(scene: "DemoScene") -> NDArray[np.float64]:
    from hapticdb.mesh import read_file  # noqa: PLC0415 - pictures alone need the tool's surface

    return np.concatenate([part.triangles() for part in read_file(scene.files.wrench).parts])


def _draw_tool(
    axes: Axes, camera: Camera, triangles: NDArray[np.float64], pose: NDArray[np.float64]
) -> None:
    """Tool at one pose, its faces lit and painted from far to near."""
    placed = triangles @ pose[:3, :3].T + pose[:3, 3]
    normals = np.cross(placed[:, 1] - placed[:, 0], placed[:, 2] - placed[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    seen = camera.project(placed.reshape(-1, 3)).reshape(-1, 3, 3)
    faces_eye = ((camera.eye - placed.mean(axis=1)) * normals).sum(axis=1) > 0
    order = np.argsort(-seen[:, :, 2].mean(axis=1))
    order = order[faces_eye[order]]
    light = 0.55 + 0.45 * np.clip(normals[order] @ np.array([0.3, 0.5, 0.81]), 0, 1)
    shades = np.clip(light[:, None] * np.array([1.0, 0.98, 0.94]), 0, 1)
    axes.add_collection(
        PolyCollection(
            (seen[order, :, :2] / SAMPLES).tolist(),
            facecolors=shades.tolist(),
            edgecolors=shades.tolist(),
            linewidths=0.3,
        )
    )


def _draw_words(figure: Figure, scene: "DemoScene", comparison: "Comparison") -> None:
    one, median_us = comparison.layouts[0].imported, comparison.layouts[0].median_us("auto")
    figure.text(0.022, 0.955, "hapticdb", color="white", fontsize=25, weight="bold", va="center")
    lines = (
        (
            f"{one.objects} parts, {one.voxels / 1e6:.1f} million voxels, "
            f"{one.bytes / 1e6:.1f} MB of {one.engine.split()[0]}"
        ),
        (
            f"{len(scene.shell)} points of a spanner looked up {len(scene.poses):,} times, "
            f"{median_us / 1000:.2f} ms each time"
        ),
    )
    for number, line in enumerate(lines):
        figure.text(0.0225, 0.917 - 0.026 * number, line, color=FAINT, fontsize=12.5, va="center")


def _draw_force(axes: Axes, trace: "Trace", palette: _Palette) -> None:
    """Force over time at 1000 frames a second, filled in the colour of the object hit most."""
    style(axes, 10)
    time = np.arange(len(trace.force))
    top = max(float(trace.force.max(initial=0.0)), 1e-9)
    main = _hit_most(trace)
    for object_id in np.unique(main).tolist():
        color = palette.of(object_id) if object_id >= 0 else PAPER
        force = np.where(main == object_id, trace.force, 0)
        axes.fill_between(time, 0, force, step="mid", color=color, alpha=0.38, linewidth=0)
    axes.plot(time, trace.force, color="white", linewidth=0.8)
    axes.set_xlim(0, max(len(time) - 1, 1))
    axes.set_ylim(0, 1.08 * top)
    axes.set_xlabel("time at 1000 frames a second, ms", color=FAINT, fontsize=11)
    axes.set_ylabel("force, N", color=FAINT, fontsize=11)
    room = LEGEND // max(len(palette.names), 1)
    labels = [(shortened(name, room), palette.colors[i]) for i, name in palette.names.items()]
    if len(set(trace.ids.tolist())) > len(labels):
        labels.append(("other parts", REST))
    marks = [
        Line2D([], [], marker="s", linestyle="", markersize=8, color=color, label=words)
        for words, color in labels
    ]
    axes.legend(
        handles=marks, loc="lower right", bbox_to_anchor=(1.0, 1.02), ncol=len(marks),
        frameon=False, labelcolor=INK, fontsize=11, handletextpad=0.2, columnspacing=1.3,
        borderaxespad=0.0,
    )  # fmt: skip


def _hit_most(trace: "Trace") -> NDArray[np.int64]:
    """Object that has most of the hits of each frame, (M,); -1 without any."""
    main = np.full(len(trace.force), -1, dtype=np.int64)
    if len(trace.ids):
        pairs, counts = np.unique(
            np.stack([trace.frames, trace.ids], axis=1), axis=0, return_counts=True
        )
        order = np.argsort(counts, kind="stable")
        main[pairs[order, 0]] = pairs[order, 1]
    return main
