"""A scene shows the triangles of the files, and follows what others commit."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
import viser

import hapticdb
from hapticdb.page.scene.view import SceneView

SECONDS = 60.0
"""Limit of each wait."""


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    made = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield made
    made.stop()


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """An environment of 40 equal balls, a box, and a mirrored wedge."""
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(2, 0.03)
    for n in range(40):
        at = trimesh.transformations.translation_matrix([0.1 * (n % 8), 0.1 * (n // 8), 0.0])
        scene.add_geometry(ball, f"ball-{n}", geom_name="ball", transform=at)
    scene.add_geometry(trimesh.creation.box((0.2, 0.1, 0.05)), "box", transform=np.eye(4))
    scene.export(tmp_path / "scene.glb")
    env = hapticdb.create(tmp_path / "scene.db", hapticdb.Grid(0.01, (-0.5, -0.5, -0.5), 8))
    with env:
        env.add(tmp_path / "scene.glb")
    return tmp_path / "scene.db"


def test_everything_is_shown_and_repeated_parts_are_one_node(
    server: viser.ViserServer, place: Path
) -> None:
    with SceneView(server, str(place)) as view:
        assert view.wait_until_shown(SECONDS)
        assert len(view.objects) == 41
        assert view.n_nodes == 2
        assert view.tree().count == 41
        assert view.up == 1
        assert [view.objects[i].name for i in view.search("BOX")] == ["box"]
