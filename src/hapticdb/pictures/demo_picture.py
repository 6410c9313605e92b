"""The demo's picture: the car, its trunk lid on the way out, the tool on its path, the force."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from hapticdb.environment import open as open_environment
from hapticdb.errors import FileError
from hapticdb.ingest.geometry import parts_of
from hapticdb.mesh import read_file
from hapticdb.pictures.canvas import Canvas
from hapticdb.store.attributes import up_axis

if TYPE_CHECKING:
    from hapticdb.demo import Answers, DemoScene

SIZE, SCENE = (1600, 1000), (1600, 740)
"""Pixels of the picture, and of the scene in its upper part."""
WINDOW = ((170, 80), (1440, 712))
"""Corners of the objects' area in the scene, pixels."""
BASE, TOP = 970, 810
"""Rows of no force and of the greatest one."""
PAPER, INK, BODY = "#e9edf3", "#242c38", "#9eb5cf"
TOOL, FREE, FORCE = "#2bb5a0", "#3aa05c", "#eb6814"
LEFT, LINE = 35, 26
"""Pixels from the edge to the words, and from one line to the next."""


def draw(path: Path, scene: "DemoScene", found: "Answers") -> None:
    """Draw the demo's environment with its answers, and write a PNG."""
    picture = Image.new("RGB", SIZE, PAPER)
    pen = ImageDraw.Draw(picture)
    canvas = _scene(scene, found)
    picture.paste(canvas.picture())
    offset = canvas.project(scene.poses[:, :3, 3])[:, :2]
    pen.line([(x, y) for x, y in offset.tolist()], fill=FORCE, width=2)
    font = ImageFont.load_default(18)
    for number, (question, answer) in enumerate(found.lines):
        colour = FREE if "comes out " in answer else INK
        pen.text((LEFT, LEFT + LINE * number), f"{question}  {answer}", fill=colour, font=font)
    across = np.linspace(LEFT, SIZE[0] - LEFT, len(found.force))
    down = BASE - (BASE - TOP) * found.force / max(float(found.force.max(initial=0.0)), 1e-9)
    curve = list(zip(across.tolist(), down.tolist(), strict=True))
    pen.line(curve, fill=FORCE, width=3)
    pen.text((LEFT, TOP - 2 * LINE), "force along the path of the spanner", fill=INK, font=font)
    try:
        picture.save(path, "PNG")
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error


def _scene(scene: "DemoScene", found: "Answers") -> Canvas:
    """The car in its file's colours, the trunk lid, and some poses of the tool."""
    with open_environment(scene.imported.url, read_only=True) as env:
        objects = env.objects()
        parts = [(obj, part) for obj, part in parts_of(env.store, objects)]
    boxes = np.array([obj.bounds for obj in objects])
    canvas = Canvas(boxes, SCENE, np.array(WINDOW, float), _rgb(PAPER), up_axis(objects))
    shift = 0.45 * (found.lid[-1, :3, 3] - found.lid[0, :3, 3])
    for obj, part in parts:
        triangles = part.surface()
        tints = np.tile(_rgb(BODY), (len(triangles), 1))
        if obj.name == "body/trunk_lid":
            triangles, tints[:] = triangles + shift, _rgb(FREE)
        elif part.colours is not None:
            tints = part.colours[:, :3] / 255.0
        canvas.fill(triangles, tints)
    tool = np.concatenate([part.triangles() for part in read_file(scene.files.spanner).parts])
    for index in np.linspace(0, len(scene.poses) - 1, 9).astype(int):
        pose = scene.poses[index]
        canvas.fill(tool @ pose[:3, :3].T + pose[:3, 3], _rgb(TOOL))
    return canvas


def _rgb(color: str) -> NDArray[np.float64]:
    return np.array(ImageColor.getrgb(color)[:3]) / 255.0
