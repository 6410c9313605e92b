"""The page's errors name no place; the part in hand is unseen."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import hapticdb
from assemblies import drop_surfaces
from children import until
from hapticdb.errors import DatabaseError, FileError, HapticDBError
from hapticdb.exact.path import ToolPath
from hapticdb.exact.swept import Gap
from hapticdb.page.panels.sweeps import SECONDS
from hapticdb.page.panels.touch import HIGHEST, PART
from hapticdb.page.tabs import TabbedBrowser
from hapticdb.page.wording import FAULT, error_text
from made_sweeps import place_at, swept
from page_person import PagePerson
from page_scene import page_of, two_parts

WAY = np.eye(4)
WAY[2, 3] = 0.02


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return two_parts(tmp_path_factory.mktemp("made"))


@pytest.fixture
def scene(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made.parent, tmp_path / "of the operator") / made.name


def test_browser_typed_survey_coordinates(tmp_path: Path) -> None:
    low = np.array([515369.25, 4918340.10, 102.0])
    box = trimesh.creation.box(bounds=[low, low + 40.0])
    box.export(tmp_path / "box.obj", digits=2)
    with hapticdb.create(tmp_path / "scene.db", hapticdb.Grid(1.0, tuple(low - 5.0), 6)) as env:
        assert env.add(tmp_path / "box.obj", unit="m").status == "imported"
    with page_of(tmp_path / "scene.db") as (_, person, browser):
        fields = [person.widgets[person.find(f"{axis}, m")] for axis in "xyz"]
        place = np.round(browser.hand[:3], 3).tolist()
        until(lambda: (person.look(0.05), [field["value"] for field in fields] == place)[1])
        assert {field["precision"] for field in fields} == {3}
        assert browser.drawing.words.text == "drag the ball"
        assert not browser.drawing.words.visible  # float32 would scatter their letters
        browser.drawing.words.visible = True
        before = browser.hand
        person.put(person.find("y, m"), 4918340.75)
        until(lambda: (person.look(0.05), browser.hand[1] == 4918340.75)[1])
        assert np.array_equal(np.delete(browser.hand, 1), np.delete(before, 1))
        until(lambda: not browser.drawing.words.visible)


def choose(browser: TabbedBrowser, name: str) -> int:
    """Choose the part of a file, as by a click; its id."""
    (found,) = (obj for obj in browser.site.objects.values() if obj.link.endswith(f"/{name}"))
    browser.parts.choose((found.id,))
    return found.id


def told(person: PagePerson, *, after: int) -> str:
    """Wait for one notification more than there were."""
    until(lambda: (person.look(0.05), len(person.told) > after)[1])
    return person.told[after]


def test_browser_errors_name_no_path(scene: Path) -> None:
    folder = scene.parent
    recordings = folder / "recorded here"
    recordings.mkdir()
    (recordings / "bad.hdbrec").write_bytes(b"nothing")
    with page_of(scene, recordings=recordings) as (site, person, browser):
        choose(browser, "box.stl")
        errors = []

        def ask(job: Any) -> None:  # noqa: ANN401 - a job of the database
            site.database.submit(job, str, browser.failed)

        drop_surfaces(scene)
        person.press("Take this part in hand")
        errors.append(told(person, after=0))
        assert "has no surface" in errors[-1]
        person.press("Run the sweep")
        person.wait_for("has no surface")

        ask(lambda env: env.object(999))
        errors.append(told(person, after=1))
        assert "no object 999 in the environment" in errors[-1]
        ask(lambda env: env.find("nothing like it"))
        errors.append(told(person, after=2))

        person.choose("Recording", "bad.hdbrec")
        errors.append(told(person, after=3))
        assert "bad.hdbrec" in errors[-1]
        until(lambda: browser.session is not None)
        shutil.rmtree(recordings)
        person.press("Record")
        errors.append(told(person, after=4))
        assert ".hdbrec" in errors[-1]
        person.look()
        for text in person.received:
            for secret in (str(folder), str(folder.parent), folder.name, "scene.db", "Traceback"):
                assert secret not in text, text


@pytest.mark.parametrize("is_direct", [False, True])
def test_browser_stiffness_only_with_coupling(scene: Path, *, is_direct: bool) -> None:
    with page_of(scene, is_direct=is_direct) as (site, person, browser):
        labels = [widget.get("label") for widget in person.widgets.values()]
        assert ("Stiffness, N/m" in labels) == site.is_coupled == (not is_direct)
        assert (browser._coupling() is None) == is_direct
        (plot,) = (one for one in person.widgets.values() if "torque" in (one.get("scales") or ()))
        top = HIGHEST * browser.tool.radius / browser.scale  # of the axis, while nothing is touched
        until(lambda: (person.look(0.05), plot["scales"]["torque"].get("max") == top)[1])


URL = "postgresql://ada:s3cret@db.example:5432/cars?environment=beetle&password=s3cret"


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("cannot read /srv/a/b.stl: it is empty", "cannot read b.stl: it is empty"),
        ("'/srv/our parts/b.stl' is gone", "'b.stl' is gone"),
        ("no object 3 in data/car.db; 'hapticdb objects data/car.db'",
         "no object 3 in the environment; 'hapticdb objects the environment'"),
        (f"no object 3 in {URL}", "no object 3 in the environment"),
        ("the server of postgresql://ada@db.example:5432/cars?environment=beetle&password=*** is",
         "the server of the environment is"),
        ("wss://there:1/x?token=s3cret: no answer", "the environment no answer"),
        ("known:folder, of parts/a.stl", "a.stl"),
        ("body/door/handle is back, 3 N/m, 1 / 2", "body/door/handle is back, 3 N/m, 1 / 2"),
    ],
)  # fmt: skip
def test_error_text_without_addresses_and_folders(said: str, expected: str) -> None:
    addresses = ("/srv/car.db", "data/car.db", URL)
    found = error_text(FileError(said), addresses, ("known:folder, of parts/", "", "/"))
    assert found == expected
    assert error_text(HapticDBError(found), addresses) == found


def test_error_text_unexpected_error_hidden() -> None:
    assert error_text(RuntimeError("/srv/a: s3cret"), ()) == FAULT
    assert error_text(DatabaseError("busy"), ()) == "busy"


@pytest.mark.long
def test_browser_dragged_part_alone_hidden(scene: Path) -> None:
    with page_of(scene) as (_, person, browser):
        for name in ("box.stl", "ball.stl"):
            part = choose(browser, name)
            person.press("Take this part in hand")
            until(lambda i=part: browser.dragged_part == i)  # type: ignore[misc]
        until(lambda: browser.scene.hidden == {part})
        tool = person.find("Tool")
        until(lambda: (person.look(0.05), person.widgets[tool]["value"] == PART)[1])
        person.press("Put it back")
        until(lambda: (browser.scene.hidden, browser.dragged_part) == (set(), None))
        until(lambda: (person.look(0.05), person.widgets[tool]["value"] == "ball")[1])
        assert person.told == []


@pytest.mark.parametrize(
    ("verdict", "told"),
    [
        ("hits", "hits ball at 50 %"),
        ("clear", "clear by 3 mm"),
        ("not decided", "hapticdb sweep has no time limit"),
    ],
)
def test_browser_sweep_verdict_shown(
    scene: Path, monkeypatch: pytest.MonkeyPatch, verdict: str, told: str
) -> None:
    with page_of(scene) as (site, person, browser):
        choose(browser, "box.stl")
        (ball,) = (obj for obj in site.objects.values() if obj.link.endswith("/ball.stl"))

        def found(_: object, shell: hapticdb.PointShell, poses: Any, **options: Any) -> Any:  # noqa: ANN401 - as `sweep`
            path = ToolPath.of(poses, shell.points, np.zeros(3))
            place = place_at(ball, 0.5, path, 0.003)
            gap = Gap(0.003, 0.003, place)
            is_stopped = verdict == "not decided" and options["seconds"] == SECONDS
            hits = (place,) if verdict == "hits" else ()
            return swept(path, hits=hits, gap=gap, is_stopped=is_stopped)

        monkeypatch.setattr("hapticdb.page.panels.sweeps.sweep", found)
        person.press("Run the sweep")
        person.wait_for(told)
        assert not any("sweep failed" in text for text in person.received)
