"""A scene follows what others commit, and shows voxels where a file must not be read or is gone."""

from collections.abc import Iterator
from pathlib import Path
from threading import Condition

import numpy as np
import pytest
import viser

import hapticdb
from hapticdb.page.scene.view import SceneEdit, SceneView
from recorded_scene import write_parts

SECONDS = 60.0
"""Limit of each wait."""


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    made = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield made
    made.stop()


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return write_parts(tmp_path, 12)


class Edits:
    """Waits for the edits of a view."""

    def __init__(self, view: SceneView) -> None:
        self.all: list[SceneEdit] = []
        self._told = Condition()
        view.on_edit(self._tell)

    def _tell(self, edit: SceneEdit) -> None:
        with self._told:
            self.all.append(edit)
            self._told.notify_all()

    def wait(self, revision: int) -> None:
        with self._told:
            reached = self._told.wait_for(
                lambda: any(edit.revision >= revision for edit in self.all), SECONDS
            )
        assert reached


def test_everything_is_shown_in_few_nodes(server: viser.ViserServer, place: Path) -> None:
    with SceneView(server, str(place)) as view:
        assert view.wait_until_shown(SECONDS)
        assert len(view.objects) == view.tree().count == 16
        assert view.n_nodes < 8
        assert view.up == 1
        assert [view.objects[i].name for i in view.search("ROD")] == ["rod"]


def test_moves_removals_and_additions_of_others_are_followed(
    server: viser.ViserServer, place: Path
) -> None:
    with SceneView(server, str(place)) as view, hapticdb.open(place) as other:
        assert view.wait_until_shown(SECONDS)
        edits = Edits(view)
        tree = view.tree()
        rod = other.find("rod")[0]
        to = rod.transform.copy()
        to[:3, 3] += 0.1, 0.05, 0.0
        moved = other.move(rod.id, to)
        edits.wait(moved.revision)
        assert view.tree() is tree  # every browser asks for it after every commit
        other.remove(1)
        edits.wait(moved.revision + 1)
        assert np.allclose(view.placement(rod.id), to)
        assert 1 not in view.objects
        assert view.tree().count == 15
        assert 1 not in view.tree().all_ids()
        box = view.box([rod.id])
        assert box is not None
        assert np.allclose(box, moved.bounds, atol=1e-6)
        middle = moved.bounds.mean(axis=0)
        found = view.pick(middle + np.array([0, 0, 3]), [0, 0, -1])
        assert found is not None
        other.add(place.with_suffix(".glb"))
        edits.wait(moved.revision + 2)
        assert view.wait_until_shown(SECONDS)
        assert len(view.objects) == view.tree().count == 16


@pytest.mark.parametrize("gone", [True, False])
def test_voxels_stand_for_files_that_are_gone_or_must_not_be_read(
    server: viser.ViserServer, place: Path, gone: bool
) -> None:
    if gone:
        place.with_suffix(".glb").unlink()
    with SceneView(server, str(place), may_read=lambda _: gone) as view:
        assert view.wait_until_shown(SECONDS)
        rod = view.objects[view.search("rod")[0]]
        box = view.box([rod.id])
        assert box is not None
        assert (box[0] <= rod.bounds[0] + 1e-9).all()
        assert (box[1] >= rod.bounds[1] - 1e-9).all()
        assert (np.ptp(box, axis=0) <= np.ptp(rod.bounds, axis=0) + 0.03).all()
        found = view.pick(rod.bounds.mean(axis=0) + np.array([0, 0, 3]), [0, 0, -1])
        assert found is not None
        assert "/" not in found.file


def test_an_environment_that_is_not_there_is_an_error(
    server: viser.ViserServer, tmp_path: Path
) -> None:
    with pytest.raises(hapticdb.EnvironmentNotFoundError):
        SceneView(server, str(tmp_path / "none.db"))
