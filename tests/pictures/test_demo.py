"""The demo: the sample, its answers, all strategies compared, and the picture."""

import dataclasses
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

import hapticdb
from hapticdb import demo
from hapticdb.cli import main
from hapticdb.errors import UsageError
from hapticdb.pictures import demo_picture

FRAMES = 25


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> demo.DemoScene:
    return demo.prepare(tmp_path_factory.mktemp("demo"), bits=7, frames=FRAMES, points=120)


@pytest.fixture(scope="session")
def found(scene: demo.DemoScene) -> demo.Answers:
    return demo.answers(scene)


@pytest.fixture(scope="session")
def comparison(scene: demo.DemoScene) -> demo.Comparison:
    return demo.compare(scene)


def test_demo_strategies_agree_on_layouts(comparison: demo.Comparison) -> None:
    assert comparison.disagreed == ()
    assert comparison.compared == FRAMES * len(demo.COMPARED) * 2
    assert comparison.verdict.startswith("all agreed")
    layouts = [measured.imported.layout for measured in comparison.layouts]
    assert layouts == ["brick", "voxel"]
    for measured in comparison.layouts:
        assert tuple(measured.queries) == demo.COMPARED
        assert all(len(queries) == FRAMES for queries in measured.queries.values())
    assert len({measured.imported.voxels for measured in comparison.layouts}) == 1


def test_demo_disagreement_reported(
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


def test_demo_answers_one_of_each_kind(found: demo.Answers) -> None:
    clash, gap, removal, force = (text for _, text in found.lines)
    assert "supply/fuel_line: overlapping, 5.67 mm" in clash
    assert "0.1257 mm apart" in gap
    assert "comes out straight" in removal
    assert f"{found.force.max():.3g} N" in force
    assert np.mean(found.force > 0.0) > 0.9
    assert np.linalg.norm(found.lid[-1, :3, 3]) > 0.9


@pytest.mark.long
def test_demo_picture_shows_scene(
    scene: demo.DemoScene, found: demo.Answers, tmp_path: Path
) -> None:
    demo_picture.draw(tmp_path / "demo.png", scene, found)
    image = np.asarray(Image.open(tmp_path / "demo.png"))
    assert image.shape == (*demo_picture.SIZE[::-1], 3)
    assert image[200:600, 300:1300].std() > 12.0
    curve = image[demo_picture.TOP : demo_picture.BASE].reshape(-1, 3)
    assert (curve == ImageColor.getrgb(demo_picture.FORCE)).all(axis=1).any()


@pytest.mark.long
def test_demo_repeated_reuses_environments(
    scene: demo.DemoScene, capfd: pytest.CaptureFixture[str]
) -> None:
    code = main(["demo", str(scene.folder), "--bits", "7", "--frames", "20", "--points", "60"])
    out, err = capfd.readouterr()
    assert code == 0
    assert out.count("there already") == 1
    for strategy in demo.COMPARED:
        assert len(re.findall(rf"^ {strategy} ", out, re.MULTILINE)) == 2
    assert out.count("auto chose") == 2
    assert "all agreed: hits, ids and wrench bit for bit" in out
    assert (scene.folder / "demo.png").exists()
    assert len(err.splitlines()) == 2


def test_demo_prepare_other_grid(scene: demo.DemoScene) -> None:
    with pytest.raises(UsageError, match="give another folder"):
        demo.prepare(scene.folder, bits=6, frames=20)
