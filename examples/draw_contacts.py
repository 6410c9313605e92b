"""Draws docs/contact/*.png: how a sweep judges a block that touches at its start.

Each case is swept first; the picture is written only if the verdict is the one of the page.
"""

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import ImageDraw

import hapticdb
from hapticdb.grid import GridOptions
from hapticdb.pictures.canvas import Canvas
from hapticdb.pictures.clash_page import PAPER, TINTS

Floats = NDArray[np.float64]
SIZE = (220, 150)
"""Pixels of a picture."""
CM = 0.01
VIEW = np.array([[[-4.0, -4.0, -1.0], [4.0, 4.0, 5.0]]]) * CM
"""Box in every picture, metres."""
BLOCK = ((0, 0, 1), (2, 2, 2))
PLATE = ((0, 0, -0.5), (6, 6, 1))
BORE = (
    ((-2, 0, 0), (2, 6, 2)), ((2, 0, 0), (2, 6, 2)), ((0, -2, 0), (2, 2, 2)),
    ((0, 2, 0), (2, 2, 2)),
)  # fmt: skip
"""Boxes around a square hole: centre and edges, centimetres."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


class Case(NamedTuple):
    """A block, what stands, and the block's shift and start, centimetres."""

    name: str
    verdict: str
    stands: tuple[Box, ...]
    shift: tuple[float, float, float]
    start: tuple[float, float, float] = (0, 0, 0)


CASES = (
    Case("lifted", "clear", (PLATE,), (0, 0, 2.5)),
    Case("slides", "slides", (PLATE,), (0, 2, 0)),
    Case("pushed", "hits", (PLATE,), (0, 0, -0.5)),
    Case("bore", "slides", BORE, (0, 0, 3)),
    Case("pressed", "overlaps", (PLATE,), (0, 0, 2.5), (0, 0, -0.05)),
    Case("again", "hits", (PLATE, ((3, 0, 3.5), (2, 6, 0.5))), (2.5, 0, 3)),
)


def mesh_of(box: Box, shift: Floats) -> trimesh.Trimesh:
    """Mesh of a box, metres."""
    centre, edges = np.array(box) * CM
    return trimesh.creation.box(
        edges, np.block([[np.eye(3), (centre + shift)[:, None]], [0, 0, 0, 1]])
    )


def draw(case: Case, folder: Path) -> None:
    """Sweep a case and write its picture."""
    shift, start = np.array(case.shift) * CM, np.array(case.start) * CM
    block = mesh_of(BLOCK, start)
    stands = [mesh_of(box, np.zeros(3)) for box in case.stands]
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = shift
    with tempfile.TemporaryDirectory() as home:
        files = [Path(home) / f"{name}.stl" for name in ("block", *range(len(stands)))]
        for mesh, file in zip((block, *stands), files, strict=True):
            mesh.export(file)
        options = hapticdb.ImportOptions(grid=GridOptions(bits=6, extent=3.0))
        hapticdb.import_files(Path(home) / "case.db", files, options)
        with hapticdb.open(Path(home) / "case.db") as env:
            found = hapticdb.sweep(env, env.shell("block"), poses, exclude=["block"], seated=True)
    if found.verdict != case.verdict:
        raise SystemExit(f"{case.name}: {found.verdict}, not {case.verdict}")
    canvas = Canvas(VIEW, SIZE, np.array([[0.0, 0.0], SIZE]), np.array(PAPER), 2)
    for mesh in stands:
        canvas.fill(np.asarray(mesh.triangles), np.array(TINTS[1]))
    canvas.fill(np.asarray(block.triangles), np.array(TINTS[0]))
    picture = canvas.picture()
    ahead = shift / np.linalg.norm(shift)
    tail = block.center_mass + (2.6 * CM * np.array([0, 0, 1]) if shift[2] < 0.0 else 0.0)
    side = np.cross(ahead, [0.0, 1.0, 0.0] if ahead[1] < 0.5 else [0.0, 0.0, 1.0])
    marks = [tail, tail + 1.8 * CM * ahead, tail + 2.4 * CM * ahead]
    marks += [marks[1] + 0.4 * CM * side, marks[1] - 0.4 * CM * side]
    start_at, neck, tip, left, right = (
        (float(x), float(y)) for x, y in canvas.project(np.stack(marks))[:, :2]
    )
    pen = ImageDraw.Draw(picture)
    pen.line([start_at, neck], fill="#242c38", width=3)
    pen.polygon([left, tip, right], fill="#242c38")
    picture.quantize(48).save(folder / f"{case.name}.png", optimize=True)


def main() -> None:
    """Draw all cases."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", nargs="?", type=Path, default=Path("docs/contact"))
    folder = parser.parse_args().out
    folder.mkdir(exist_ok=True)
    for case in CASES:
        draw(case, folder)
        print(f"{case.name}: {case.verdict}")


if __name__ == "__main__":
    main()
