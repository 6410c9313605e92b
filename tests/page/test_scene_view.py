"""A scene follows what others commit, and shows voxels of objects without a surface."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import viser

import hapticdb
from assemblies import drop_surfaces
from children import until
from hapticdb.page.scene.contents import ALL
from hapticdb.page.scene.picking import RayHit
from hapticdb.page.scene.view import SceneView
from hapticdb.store.base import Object
from recorded_scene import write_parts


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    made = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield made
    made.stop()


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return write_parts(tmp_path, 12)


def all_shown(view: SceneView) -> None:
    """Wait until no object is a box."""
    until(lambda: view.contents.waiting() == 0)


def from_above(view: SceneView, obj: Object) -> RayHit | None:
    """What a ray from above meets in the middle of an object."""
    middle = obj.bounds.mean(axis=0)
    return view.contents.pick(middle + np.array([0, 0, 3]), [0, 0, -1], lambda _: True)


def test_scene_view_follows_commits(server: viser.ViserServer, place: Path) -> None:
    with closing(SceneView(server, str(place))) as view, hapticdb.open(place) as other:
        all_shown(view)
        assert len(view.objects) == 16
        assert (len(view.contents._audiences[ALL][0].names) < 8, view.up) == (True, 1)
        rod = other.find("rod")[0]
        to = rod.transform.copy()
        to[:3, 3] += 0.1, 0.05, 0.0
        moved = other.move(rod.id, to)
        until(lambda: view.revision >= moved.revision)
        other.remove(1)
        until(lambda: view.revision > moved.revision)
        assert 1 not in view.objects
        assert len(view.objects) == 15
        found = from_above(view, moved)
        assert found is not None
        assert found.id == rod.id
        assert found.point[2] == pytest.approx(moved.bounds[1, 2], abs=0.01)
        other.add(place.with_suffix(".glb"))
        until(lambda: view.revision > moved.revision + 1)
        all_shown(view)
        assert len(view.objects) == 16


@pytest.mark.parametrize("has_surfaces", [True, False])
def test_scene_view_voxels_without_surface(
    server: viser.ViserServer, place: Path, has_surfaces: bool
) -> None:
    place.with_suffix(".glb").unlink()
    if not has_surfaces:
        drop_surfaces(place)
    with closing(SceneView(server, str(place))) as view:
        all_shown(view)
        rod = next(obj for obj in view.objects.values() if obj.name.endswith("rod"))
        found = from_above(view, rod)
        assert found is not None
        above = found.point[2] - rod.bounds[1, 2]
        assert abs(above) < 1e-4 if has_surfaces else -1e-9 <= above <= 0.03


def test_scene_view_missing_environment(server: viser.ViserServer, tmp_path: Path) -> None:
    with pytest.raises(hapticdb.errors.EnvironmentNotFoundError):
        SceneView(server, str(tmp_path / "none.db"))
