"""The demo: the sample, all strategies compared, and the picture."""

import dataclasses
import re
from collections import Counter
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

import hapticdb
from hapticdb import demo
from hapticdb.cli import main
from hapticdb.errors import UsageError
from hapticdb.pictures import demo as demo_picture
from hapticdb.pictures.splat import Camera, empty_depths, shade, splat


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> demo.DemoScene:
    return demo.prepare(tmp_path_factory.mktemp("demo"), bits=7, frames=60, points=120)


@pytest.fixture(scope="session")
def comparison(scene: demo.DemoScene) -> demo.Comparison:
    return demo.compare(scene)


def test_every_strategy_agrees_on_both_layouts(comparison: demo.Comparison) -> None:
    assert comparison.disagreed == ()
    assert comparison.compared == 60 * len(demo.COMPARED) * 2
    assert comparison.verdict.startswith("all agreed")
    layouts = [measured.imported.layout for measured in comparison.layouts]
    assert layouts == ["brick", "voxel"]
    for measured in comparison.layouts:
        assert tuple(measured.felt) == demo.COMPARED
        assert all(len(queries) == 60 for queries in measured.felt.values())
    assert len({measured.imported.voxels for measured in comparison.layouts}) == 1


def test_a_disagreement_is_told(
    scene: demo.DemoScene, comparison: demo.Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = demo._found
    calls = Counter[str]()

    def wrong_once(touched: hapticdb.Touch) -> tuple[bytes, bytes, bytes, tuple[int, ...]]:
        calls["made"] += 1
        force, *rest = found(touched)
        return (b"" if calls["made"] == 9 else force, *rest)  # type: ignore[return-value]

    monkeypatch.setattr(demo, "_found", wrong_once)
    short = dataclasses.replace(scene, poses=scene.poses[:3])
    result = demo.compare(short)
    assert result.disagreed == ("pose 1 by maxgap on the brick layout",)
    assert result.verdict.startswith("DISAGREED: pose 1")
    assert comparison.verdict != result.verdict


def test_the_path_touches_the_sample(comparison: demo.Comparison) -> None:
    trace = comparison.trace
    assert np.mean(trace.hits > 0) > 0.9
    assert np.all(np.bincount(trace.frames, minlength=60) == trace.hits)
    assert trace.force.max() > 0


@pytest.mark.long
def test_the_picture_shows_the_scene(
    scene: demo.DemoScene, comparison: demo.Comparison, tmp_path: Path
) -> None:
    demo_picture.draw(tmp_path / "demo.png", scene, comparison)
    image = matplotlib.image.imread(tmp_path / "demo.png")
    assert image.shape[:2] == demo_picture.SIZE[::-1]
    scenery = image[200:600, 300:1300, :3]
    assert scenery.std() > 0.05


@pytest.mark.long
def test_a_second_demo_finds_its_environments_there(
    scene: demo.DemoScene, capfd: pytest.CaptureFixture[str]
) -> None:
    code = main(["demo", str(scene.folder), "--bits", "7", "--frames", "20", "--points", "60"])
    out, err = capfd.readouterr()
    assert code == 0
    assert out.count("there already") == 2
    for strategy in demo.COMPARED:
        assert len(re.findall(rf"^ {strategy} ", out, re.MULTILINE)) == 2
    assert out.count("auto chose") == 2
    assert "all agreed: hits, ids and wrench bit for bit" in out
    assert (scene.folder / "demo.png").exists()
    assert len(err.splitlines()) == 1


def test_another_grid_in_the_same_folder_is_refused(scene: demo.DemoScene) -> None:
    with pytest.raises(UsageError, match="give another folder"):
        demo.prepare(scene.folder, bits=6, frames=20)


# -- voxels to pixels ------------------------------------------------------------------------------


def camera_above(size: tuple[int, int] = (80, 60)) -> Camera:
    box = np.array([[[-1.0, -1.0, -0.1], [1.0, 1.0, 0.1]]])
    window = np.array([[8.0, 6.0], [72.0, 54.0]])
    return Camera.looking_at(box, np.array([0.2, 0.3, 0.9]), size, window)


def test_the_nearer_voxel_is_seen_whatever_the_order() -> None:
    camera = camera_above()
    near, far = (
        np.array([[0.0, 0.0, 0.1]]),
        np.array([[0.0, 0.0, 0.1]])
        - 0.1 * ((camera.eye - [0, 0, 0.1]) / np.linalg.norm(camera.eye - [0, 0, 0.1])),
    )
    pixel = tuple(camera.project(near)[0, :2].astype(int)[::-1])
    seen = []
    for order in ((0, 1), (1, 0)):
        depths = empty_depths(camera)
        for number in order:
            splat(depths, camera, (near, far)[number], 0.1, number)
        seen.append(int(depths[pixel] & 0xFFFFF))
    assert seen == [0, 0]


def test_a_surface_towards_the_light_is_brighter() -> None:
    camera = camera_above((160, 120))
    xy = np.stack(np.meshgrid(np.linspace(-1, 1, 200), np.linspace(-1, 1, 200)), axis=-1)
    x, y = xy.reshape(-1, 2).T
    brightness = []
    for slope in (-1.0, 1.0):  # the light comes from +y
        depths = empty_depths(camera)
        splat(depths, camera, np.stack([x, y, 0.3 * slope * y], axis=1), 0.02, 0)
        image = shade(depths, camera, np.full((1, 3), 0.5), np.zeros(3), 0.02)
        row, column = camera.project(np.zeros((1, 3)))[0, 1::-1].astype(int)
        brightness.append(float(image[row, column].mean()))
    assert brightness[0] > brightness[1]
