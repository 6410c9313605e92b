"""What a person sees of jobs and parts, without a browser."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

import hapticdb
from hapticdb.errors import UsageError
from hapticdb.kernels._sets import building
from hapticdb.page.browser import put
from hapticdb.page.colours import MARKED
from hapticdb.page.connection import Visitor
from hapticdb.page.panels.jobs import COMPILES, WAITS, PanelJob, Progress
from hapticdb.page.panels.tree import PartTree
from hapticdb.page.panels.viewing import ViewControls
from hapticdb.page.scene.browser_scene import SHEER
from hapticdb.units import length_text
from page_scene import page_of, two_parts


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return two_parts(tmp_path_factory.mktemp("seen"))


def test_panel_job_progress_then_result() -> None:
    said: list[str] = []
    with ThreadPoolExecutor(1) as threads:
        site = SimpleNamespace(sweeping=threads)
        browser: Any = SimpleNamespace(site=site, has_gone=False, works=[])
        work = PanelJob(browser, MagicMock(), "a search", "pairs")

        def note() -> None:
            work.tick()
            said.append(work.said.content)

        def job(progress: Progress) -> None:
            note()
            building.add("triangles")
            note()
            building.clear()
            progress(372, 1163)
            note()
            with pytest.raises(UsageError, match="a search is running"):
                work.begin(job, print)

        def show(_: None) -> None:
            work.said.content = "2 pairs"
            note()

        work.begin(job, show)
    assert browser.works == [work]
    for words, text in zip(("Reads the parts.", COMPILES, "1,163 pairs: 31 %"), said, strict=False):
        assert words in text
    assert said[3] == "2 pairs"
    assert not any(WAITS in text for text in said)


def test_browser_scene_shadow_of_visible_objects(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(
        "hapticdb.page.scene.browser_scene.add_shadow", lambda _, boxes, *__: drawn.append(boxes)
    )
    with page_of(scene) as (site, _, browser):
        (box, ball) = site.objects.values()
        browser.scene.hide([ball.id])
        assert np.allclose(drawn[-1], [box.bounds], atol=1e-6)
        browser.scene.isolate([])
        assert drawn[-1].shape == (0, 2, 3)
        browser.scene.show()
        assert len(drawn[-1]) == 2


@pytest.mark.parametrize("search", ["", "pump"])
def test_parts_tree_thousands_of_objects(search: str) -> None:
    names = {i: f"plant {i % 40}/unit {i % 300}/{'pump' * (i % 7 > 0)} {i}" for i in range(4211)}
    objects = {i: SimpleNamespace(name=name) for i, name in names.items()}
    groups: list[Any] = []
    pressed: list[Any] = []

    def add(_: str, options: tuple[str, ...]) -> Any:  # noqa: ANN401 - in place of viser's
        groups.append(MagicMock(options=options))
        return groups[-1]

    gui = MagicMock(add_button_group=add)
    gui.add_text.return_value.value = search
    browser: Any = SimpleNamespace(
        site=SimpleNamespace(objects=objects), scene=SimpleNamespace(hidden={*range(0, 4211, 300)}),
        chosen=tuple(range(0, 4211, 40)), guarded=lambda _, act: act,
    )  # fmt: skip
    tree = PartTree(browser, gui, pressed.append)
    options = [text for group in groups for text in group.options]
    assert 50 < len(options) < 500
    assert gui.add_folder.call_count < 70
    whole = next(group for group in groups if any("✓" in text for text in group.options))
    mark = next(text for text in whole.options if "✓" in text)
    whole.on_click.call_args.args[0](SimpleNamespace(target=SimpleNamespace(value=mark)))
    if search:
        assert all("pump" in text for text in options)
        assert len(pressed[0]) == 1
    else:
        assert mark == "✓ all"
        assert sorted(pressed[0]) == [*browser.chosen]
    n_folders = gui.add_folder.call_count
    tree.show()  # of a move by another: nothing is listed anew
    assert gui.add_folder.call_count == n_folders


def test_view_controls_section_plane_and_link() -> None:
    camera = MagicMock(position=np.array([0.0, -3.0, 0.0]), look_at=np.zeros(3), near=0.01)
    bounds = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    site = MagicMock(view=SimpleNamespace(up=2), facts=SimpleNamespace(bounds=bounds))
    site.server.initial_camera.near = 0.01
    browser: Any = SimpleNamespace(
        client=SimpleNamespace(camera=camera), site=site, chosen=(4, 7),
        guarded=lambda _, act: act, visitor=Visitor("Ada", "viewer"),
    )  # fmt: skip
    view = ViewControls(browser, MagicMock())
    put(view._section, 25.0)
    moved = camera.on_update.call_args.args[0]
    moved(camera)
    assert camera.near == pytest.approx(2.5)
    start = view.seen_from(camera.position, np.array([0.0, 1.0, 0.0]))
    assert start == pytest.approx([0.0, -0.5, 0.0])
    view.tick(1.0)
    for words in ('href="see/4,7?', "Position=0,-3,0&amp;", "LookAt=0,0,0&amp;", "Near=2.5"):
        assert words in view._link.content
    assert ViewControls(browser, MagicMock())._share_of_near() == pytest.approx(0.25)
    camera.position = np.array([0.0, -9.0, 0.0])  # the section stays where it is in the scene
    moved(camera)
    assert camera.near == pytest.approx(8.5)


def test_parts_distance_of_two_selected(scene: Path) -> None:
    with page_of(scene) as (site, person, browser):
        browser.parts.choose([*site.objects])
        with hapticdb.open(scene, read_only=True) as env:
            found = env.distance(*site.objects)
        person.press("Measure between two chosen parts")
        person.wait_for(f">{length_text(found.at_most)}<")
        browser.scene.see_through(browser.chosen)
        colours = [browser.scene._state.colour(SimpleNamespace(id=i)) for i in site.objects]  # type: ignore[arg-type]
        assert colours == [(*MARKED, SHEER)] * 2
