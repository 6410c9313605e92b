"""What browsers draw is what the files hold, less what they hide, at the places of now."""

from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from assemblies import small_options
from children import until
from hapticdb.mesh import read_file
from hapticdb.page.colours import FADED, MARKED, Colour, Rgba
from hapticdb.page.scene.contents import Contents
from hapticdb.page.scene.drawings import Audience
from hapticdb.page.scene.nodes import Appearance, Member
from hapticdb.page.scene.reading import ShapeReader
from hapticdb.store.base import Object
from recorded_scene import RecordedScene, are_same, drawn, write_parts

parsed = cache(read_file)


class Shown:
    """Contents of an environment with their shapes, and the triangles of each object."""

    def __init__(self, path: Path) -> None:
        with hapticdb.open(path, read_only=True) as env:
            self.objects = env.objects()
        parts = {part.name: part for part in parsed(self.objects[0].link).parts}
        self.triangles = {obj.id: parts[obj.name].triangles(obj.transform) for obj in self.objects}
        self.scene = RecordedScene()
        self.contents = Contents(Audience(cast("Any", self.scene)))
        self.contents.add(self.objects)
        self.n_boxes = len(drawn(self.scene))
        reader = ShapeReader(str(path), self.contents.shape, lambda _: None)
        reader.read(self.objects)
        until(lambda: self.contents.waiting() == 0)
        reader.close()
        reader.thread.join(60.0)

    def of(self, ids: set[int]) -> NDArray[np.float64]:
        return np.concatenate([np.empty((0, 3, 3)), *(self.triangles[i] for i in sorted(ids))])


def marked_by(marks: dict[int, Colour]) -> Appearance:
    """Sees the objects that have a mark, in its colour."""
    return lambda member: marks.get(member.id)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_parts(tmp_path_factory.mktemp("parts"))


@pytest.fixture
def shown(path: Path) -> Shown:
    return Shown(path)


def test_contents_boxes_then_each_triangle_once(shown: Shown) -> None:
    """Equal parts are one node; a mirrored one is drawn, too."""
    assert shown.n_boxes == 12 * len(shown.objects)
    assert len(shown.scene.nodes) < 10
    assert are_same(drawn(shown.scene), shown.of(set(shown.triangles)))


def test_contents_survey_coordinates(tmp_path: Path) -> None:
    """A browser has vertices and places in float32, which knows half metres there."""
    where = np.array([515_369.0, 4_918_340.0, 2_322.0])
    shown = Shown(write_parts(tmp_path, where=where.tolist()))
    wanted = shown.of(set(shown.triangles)) - where
    assert are_same(drawn(shown.scene) - where, wanted)


def test_contents_colours_and_transparency(tmp_path: Path, path: Path) -> None:
    nodes = [vars(node) for node in Shown(path).scene.nodes.values()]
    red = np.array([200, 40, 40])  # light, as in the file
    assert sum(bool((np.abs(node["batched_colors"] - red) < 2).all()) for node in nodes) == 1
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.visual.face_colors = [[200, 40, 40, 255]] * 8 + [[40, 40, 200, 64]] * 4
    box.export(tmp_path / "box.ply")
    hapticdb.import_files(tmp_path / "box.db", [tmp_path / "box.ply"], small_options())
    two = Shown(tmp_path / "box.db")
    assert are_same(drawn(two.scene), two.of({1}))
    nodes = [vars(node) for node in two.scene.nodes.values()]
    found = sorted((len(node["faces"]), node["opacity"]) for node in nodes)
    assert found == [(4, pytest.approx(64 / 255)), (8, None)]


def test_contents_cloud_colours_hidden_and_marked(tmp_path: Path) -> None:
    """Hidden it is gone, marked it has the colour of what is marked."""
    points = np.random.default_rng(1).uniform(0.0, 1.0, (500, 3))
    for colours in (None, np.tile(np.array([[9, 99, 199, 255]], dtype=np.uint8), (500, 1))):
        trimesh.PointCloud(points, colors=colours).export(tmp_path / "cloud.ply")
        hapticdb.import_files(tmp_path / f"{colours is None}.db", [tmp_path / "cloud.ply"])
        shown = Shown(tmp_path / f"{colours is None}.db")
        (node,) = map(vars, shown.scene.nodes.values())
        found = np.sort(node["points"] + node["position"], axis=0)
        np.testing.assert_allclose(found, np.sort(points, axis=0), atol=1e-6)
        shades = len(np.unique(node["colors"], axis=0))
        assert shades == 1 if colours is not None else shades > 100
        own, marks = RecordedScene(), {1: MARKED}
        shown.contents.watch("one", Audience(cast("Any", own)), marked_by(marks))
        (node,) = map(vars, own.nodes.values())
        np.testing.assert_array_equal(node["colors"], MARKED)
        marks.clear()
        shown.contents.see("one", [1])
        assert not any("points" in vars(node) for node in own.nodes.values())


shown_once = cache(Shown)
"""Contents that the examples of a test share."""


@settings(max_examples=15, deadline=None)
@given(
    st.sets(st.integers(1, 34)),
    st.sets(st.integers(1, 34)),
    st.sampled_from([MARKED, FADED]),
    st.integers(0, 2),
)
def test_contents_appearance_per_browser(
    path: Path, hidden: set[int], marked: set[int], shade: Colour | Rgba, rounds: int
) -> None:
    shown, own = shown_once(path), RecordedScene()
    state: dict[str, set[int]] = {"hidden": set(), "marked": set()}

    def appearance(member: Member) -> Colour | Rgba | None:
        if member.id in state["hidden"]:
            return None
        return shade if member.id in state["marked"] else member.colour

    shown.contents.watch("one", Audience(cast("Any", own)), appearance)
    everything = set(shown.triangles)
    for _ in range(rounds + 1):
        state["hidden"], state["marked"] = hidden, marked
        shown.contents.see("one", everything)
        seen = drawn(shown.scene, own)
        assert are_same(seen, shown.of(everything - hidden))
        faded = RecordedScene()
        faded.nodes = {name: n for name, n in own.nodes.items() if vars(n).get("opacity")}
        assert are_same(drawn(faded), shown.of(marked - hidden if shade is FADED else set()))
        state["hidden"], state["marked"] = set(), set()
        shown.contents.see("one", everything)
        assert own.nodes == {}  # it sees the shared nodes again
    shown.contents.leave("one")
    assert are_same(drawn(shown.scene), shown.of(everything))


def placed(obj: Object, seed: int) -> NDArray[np.float64]:
    """Another place of an object: turned about the world's z, and shifted."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 6)
    motion = np.eye(4)
    motion[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    motion[:3, 3] = rng.uniform(-0.2, 0.2, 3)
    return motion @ obj.transform


def moved(triangles: NDArray[np.float64], obj: Object, to: NDArray[np.float64]) -> Any:  # noqa: ANN401
    way = to @ np.linalg.inv(obj.transform)
    return triangles @ way[:3, :3].T + way[:3, 3]


def test_contents_moves_drawn_with_few_bytes(shown: Shown) -> None:
    """A commit takes the place of a preview."""
    contents, expected = shown.contents, dict(shown.triangles)
    for obj in (shown.objects[0], shown.objects[3], shown.objects[-1], shown.objects[-2]):
        for seed in (1, 2):
            to = placed(obj, seed + obj.id)
            assert contents.move(obj.id, to)
            contents.refresh()
            expected[obj.id] = moved(shown.triangles[obj.id], obj, to)
        before = shown.scene.bytes_sent
        contents.move(obj.id, placed(obj, 77))
        contents.refresh()
        assert shown.scene.bytes_sent - before < 28 * 35
        contents.move(obj.id, to)
        contents.refresh()
    assert are_same(drawn(shown.scene), np.concatenate(list(expected.values())))
    contents.move(obj.id, obj.transform, obj)
    contents.refresh()
    expected[obj.id] = shown.triangles[obj.id]
    assert are_same(drawn(shown.scene), np.concatenate(list(expected.values())))


def test_contents_removed_objects_not_drawn(shown: Shown) -> None:
    gone = {shown.objects[0].id, shown.objects[3].id, shown.objects[-2].id}
    shown.contents.remove([*gone, 10_000])
    shown.contents.refresh()
    left = set(shown.triangles) - gone
    assert are_same(drawn(shown.scene), shown.of(left))
    assert shown.contents.pick([0, 0, -5], [0, 0, 1], lambda i: i in gone) is None
