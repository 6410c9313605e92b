"""The demo's picture: the scene, the tool on its path, objects in contact, the force."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from hapticdb.environment import Environment
from hapticdb.environment import open as open_environment
from hapticdb.errors import FileError
from hapticdb.ingest.geometry import parts_of
from hapticdb.mesh import read_file
from hapticdb.pictures.canvas import Canvas
from hapticdb.store.attributes import up_axis

if TYPE_CHECKING:
    from hapticdb.demo import Comparison, DemoScene, Trace

SIZE, SCENE = (1600, 1000), (1600, 740)
"""Pixels of the picture, and of the scene in its upper part."""
WINDOW = ((170, 30), (1480, 712))
"""Corners of the objects' area in the scene, pixels."""
BASE, TOP = 970, 790
"""Rows of no force and of the greatest one."""
PAPER, FAINT, BODY, TOOL = "#0f1419", "#7d8896", "#6f7b89", "#e8e2d4"
COLORS = ("#ffb000", "#35c6f4", "#ff5d73", "#7ee081", "#c792ff", "#ff8f4d")
"""Of the objects hit most, the most hit one first."""
TOOLS_SHOWN = 9
"""Number of poses with a picture of the tool."""
LEFT, LINE = 35, 24
"""Pixels from the edge to the words, and from one line to the next."""


def draw(path: Path, scene: "DemoScene", comparison: "Comparison") -> None:
    """Draw the first environment of a demo and its contacts, and write a PNG."""
    with open_environment(scene.imported[0].url, read_only=True) as env:
        picture = _compose(env, scene, comparison)
    try:
        picture.save(path, "PNG")
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error


def _compose(env: Environment, scene: "DemoScene", comparison: "Comparison") -> Image.Image:
    trace, objects = comparison.trace, env.objects()
    most = [i for i, _ in Counter(trace.ids.tolist()).most_common(len(COLORS))]
    colors = dict(zip(most, COLORS, strict=False))
    boxes = np.array([obj.bounds for obj in objects])
    canvas = Canvas(boxes, SCENE, np.array(WINDOW, float), _rgb(PAPER), up_axis(objects))
    parts = [(obj, part.surface()) for obj, part in parts_of(env.store, objects)]
    tints = [np.tile(_rgb(colors.get(obj.id, BODY)), (len(faces), 1)) for obj, faces in parts]
    canvas.fill(np.concatenate([faces for _, faces in parts]), np.concatenate(tints))
    tool = np.concatenate([part.triangles() for part in read_file(scene.files.spanner).parts])
    for index in np.linspace(0, len(scene.poses) - 1, TOOLS_SHOWN).astype(int):
        pose = scene.poses[index]
        canvas.fill(tool @ pose[:3, :3].T + pose[:3, 3], _rgb(TOOL))
    picture = Image.new("RGB", SIZE, PAPER)
    picture.paste(canvas.picture())
    pen = ImageDraw.Draw(picture)
    way = canvas.project(scene.poses[:, :3, 3])[:, :2]
    pen.line([(x, y) for x, y in way.tolist()], fill="white", width=2)
    names = {obj.id: obj.name.rsplit("/", 1)[-1].replace("_", " ") for obj in objects}
    _write(pen, scene, comparison, [(names[i], color) for i, color in colors.items()])
    _draw_force(pen, trace)
    return picture


def _rgb(color: str) -> NDArray[np.float64]:
    return np.array(ImageColor.getrgb(color)[:3]) / 255.0


def _write(
    pen: ImageDraw.ImageDraw,
    scene: "DemoScene",
    comparison: "Comparison",
    legend: list[tuple[str, str]],
) -> None:
    """Write the facts, and the names of the objects hit most, each in its colour."""
    one, median_us = comparison.layouts[0].imported, comparison.layouts[0].median_us("auto")
    facts = (
        (
            f"{one.objects} parts, {one.voxels / 1e6:.1f} million voxels, "
            f"{one.bytes / 1e6:.1f} MB of {one.engine.split()[0]}"
        ),
        (
            f"{len(scene.shell)} points of a spanner looked up {len(scene.poses):,} times, "
            f"{median_us / 1000:.2f} ms each time"
        ),
    )
    lines = [*((fact, FAINT) for fact in facts), *legend]
    font = ImageFont.load_default(18)
    for number, (words, color) in enumerate(lines):
        pen.text((LEFT, LEFT + LINE * number), words, fill=color, font=font)


def _draw_force(pen: ImageDraw.ImageDraw, trace: "Trace") -> None:
    """Draw the force along the path, with its greatest value."""
    most = float(trace.force.max(initial=0.0))
    across = np.linspace(LEFT, SIZE[0] - LEFT, len(trace.force))
    down = BASE - (BASE - TOP) * trace.force / max(most, 1e-9)
    curve = list(zip(across.tolist(), down.tolist(), strict=True))
    pen.polygon([(LEFT, BASE), *curve, (SIZE[0] - LEFT, BASE)], fill="#2a3644")
    pen.line(curve, fill="white", width=2)
    words = f"force along the path, at most {most:.3g} N"
    pen.text((LEFT, TOP - 2 * LINE), words, fill=FAINT, font=ImageFont.load_default(18))
