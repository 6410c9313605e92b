"""Pictures: scenes are upright and not cut, text covers nothing, lengths are readable."""

from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib.figure import Figure

import hapticdb
from hapticdb import Grid, PointShell
from hapticdb.pictures.demo import PAPER, SCENE, SIZE, TOWARDS, mixed
from hapticdb.pictures.splat import Camera, faded, turned
from hapticdb.pictures.sweep import compose_sweep, extent_of
from hapticdb.store.attributes import AXES, up_axis
from hapticdb.sweeps.result import Profile
from hapticdb.sweeps.way import Way
from hapticdb.units import length_text, readable_unit
from made_sweeps import place_at, swept

LONG = "assembly > sub-assembly 0123456789 > " * 4


@pytest.mark.parametrize("up", [0, 1, 2])
def test_the_axis_that_points_up_does_so_in_the_picture(up: int) -> None:
    window = np.array([[10.0, 10.0], [190.0, 140.0]])
    box = np.array([[[0.0, 0.0, 0.0], [2.0, 3.0, 1.0]]])
    camera = Camera.looking_at(box, np.array(TOWARDS), (200, 150), window, up)
    foot = np.array([1.0, 1.0, 1.0])
    (x0, y0, _), (x1, y1, _) = camera.project(np.stack([foot, foot + np.eye(3)[up]]))
    assert y1 < y0  # pixel rows count downwards
    assert abs(x1 - x0) < 0.25 * (y0 - y1)
    assert np.linalg.det(np.stack([turned(row, up) for row in np.eye(3)])) == pytest.approx(1.0)


def test_what_most_voxels_say_is_up() -> None:
    grid = Grid(0.1, (0, 0, 0), 4)

    def votes(*said: tuple[object, int]) -> str:
        return AXES[up_axis([
            hapticdb.Object("p", "a", "", np.eye(4), n, np.zeros((2, 3)),
                            {} if up is None else {"up": up})
            for up, n in said
        ])]  # fmt: skip

    assert grid.side == 16
    assert votes() == votes((None, 5)) == votes(("y", 3), (None, 3)) == "z"
    assert votes(("y", 4), ("z", 3)) == "y"
    assert votes(("x", 4)) == "x"
    assert votes((["y"], 4), ("north", 2)) == "z"


def test_a_scene_that_goes_on_fades_and_is_not_cut() -> None:
    camera = Camera.looking_at(
        np.array([[[0.0, 0, 0], [1, 1, 1]]]), np.array(TOWARDS), (120, 90),
        np.array([[0.0, 0], [120, 90]]),
    )  # fmt: skip
    paper = np.array(mixed(PAPER, PAPER, 0.0))
    image = faded(np.ones((90, 120, 3), dtype=np.float32), camera, paper, 20)
    edge = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert (edge < 0.2).all()
    assert (image[20:-20, 20:-20] == 1.0).all()
    assert np.abs(np.diff(image, axis=0)).max() < 0.1


@pytest.mark.parametrize(
    ("length", "text"),
    [(12_500.0, "12.5 km"), (4_280.0, "4280 m"), (0.1274, "0.1274 m"), (0.0067, "6.7 mm"),
     (1e-5, "10 µm"), (0.0, "0 µm")],
)  # fmt: skip
def test_lengths_are_in_the_unit_that_reads_best(length: float, text: str) -> None:
    assert length_text(length) == text
    assert text.endswith(f" {readable_unit(length)[1]}")


def swept_figure(folder: Path, scale: float, names: list[str], reach: float = 1.0) -> Figure:
    """Figure of a sweep over plates with the given names; the tool hits all of the plates."""
    assembly = trimesh.Scene()
    for n, name in enumerate(names):
        box = trimesh.creation.box((scale, scale, 0.05 * scale))
        place = trimesh.transformations.translation_matrix((0, -0.2 * scale * n, 0))
        assembly.add_geometry(box, node_name=name, geom_name=f"g{n}", transform=place)
    (folder / "a.glb").write_bytes(assembly.export(file_type="glb"))
    grid = Grid(scale / 32, (-2 * scale, -3 * scale, -2 * scale), 7)
    with hapticdb.create(folder / "a.db", grid) as env:
        env.add(folder / "a.glb")
        assert up_axis(env.objects()) == 1
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[:, 1, 3] = reach * scale, -reach * scale
        shell = PointShell.sphere(0.1 * scale, 60)
        path = Way.of(poses, shell.points, np.zeros(3))
        hits = tuple(
            place_at(obj, 0.1 * n, path, 0.1 * scale) for n, obj in enumerate(env.objects())
        )
        profile = Profile(np.array([0.0, 0.2, 1.0]), scale * np.array([0.3, 0.0, 0.1]))
        found = swept(path, hits=hits, profile=profile)
        return compose_sweep(env, shell, found, verdict=f"hits {', '.join(names)}")


@pytest.mark.parametrize("scale", [0.02, 2000.0])
def test_no_words_run_over_others_or_the_edge(tmp_path: Path, scale: float) -> None:
    figure = swept_figure(tmp_path, scale, [f"{LONG}{n}" for n in range(8)])
    boxes = [extent_of(text) for text in figure.texts]
    boxes += [extent_of(text) for text in figure.axes[0].texts]
    assert len(boxes) >= 2 + 6
    for one, other in combinations(boxes, 2):
        assert not one.overlaps(other)
    for box in boxes:
        assert box.x0 >= 0
        assert box.x1 <= SIZE[0]
        assert box.y1 <= SIZE[1]
    words = " ".join(text.get_text() for text in figure.texts)
    assert "4000 m along" in words if scale > 1 else "40 mm along" in words
    assert figure.axes[1].get_ylabel() == ("gap, m" if scale > 1 else "gap, mm")


@pytest.mark.parametrize("reach", [0.15, 1.0])
def test_no_scene_is_cut_at_the_edges_of_its_picture(tmp_path: Path, reach: float) -> None:
    """The scene is in view or fades out: the rows and columns at the edges are background."""
    figure = swept_figure(tmp_path, 0.5, ["plate"], reach)
    (image,) = figure.axes[0].images
    pixels = np.asarray(image.get_array())
    assert pixels.shape[:2] == SCENE[::-1]
    assert pixels.max() > 0.3
    for edge in (pixels[:3], pixels[-3:], pixels[:, :3], pixels[:, -3:]):
        assert edge.max() < 0.2
    for row, below in pairwise(pixels[-40:]):
        assert np.abs(row - below).max() < 0.2
