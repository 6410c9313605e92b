"""A tool, path or scene of the wrong unit is reported with its factor; right ones never are."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from command_line import Run, made, poses, refused, run, scene, succeeded, tool  # noqa: F401 - fixtures
from hapticdb import Object, PointShell, Proportions, compare_proportions
from hapticdb.errors import UsageError
from hapticdb.poses import rotation_of
from hapticdb.sweeps.way import Way
from hapticdb.units import UNITS

TOOL = ("--tool", "tool.stl")
VOXEL = 1 / 512


def objects(*boxes: tuple[tuple[float, ...], tuple[float, ...]]) -> list[Object]:
    return [
        Object(name=f"{i}", link="a.stl", digest="", transform=np.eye(4), voxels=1,
               bounds=np.array(box), id=i)
        for i, box in enumerate(boxes, start=1)
    ]  # fmt: skip


def car(factor: float = 1.0) -> list[Object]:
    """A scene of 4 m about the origin, in eight blocks with room between them."""
    corners = [(x, y, z) for x in (-2, 1) for y in (-1, 0.2) for z in (0.0, 0.8)]
    return objects(*(
        (tuple(factor * c for c in low), tuple(factor * (c + 0.8) for c in low)) for low in corners
    ))  # fmt: skip


def wrench(length: float = 0.25) -> PointShell:
    mesh = trimesh.creation.box((length, 0.2 * length, 0.05 * length))
    return PointShell.from_mesh(mesh.vertices, mesh.faces, 60)


def along(*places: Iterable[float], factor: float = 1.0) -> NDArray[np.float64]:
    made = np.tile(np.eye(4), (len(places), 1, 1))
    made[:, :3, 3] = factor * np.array([list(place) for place in places])
    return made


SLIDE = ((-2, 0, 1.6), (0, 0.5, 1.7), (1.5, 0.7, 1.65))


def found(
    scene: list[Object], shell: PointShell, path: NDArray[np.float64] | None, **given: object
) -> Proportions:
    largest = max(float((obj.bounds[1] - obj.bounds[0]).max()) for obj in scene)
    return compare_proportions(scene, VOXEL * largest, shell, path, **given)  # type: ignore[arg-type]


# -- wrong sizes, and by which factor --------------------------------------------------------------


def test_what_fits_is_not_told() -> None:
    fit = found(car(), wrench(), along(*SLIDE))
    assert (fit.misfits, fit.gap, fit.text) == ((), 0.0, "")
    assert fit.tool == pytest.approx(0.25, rel=0.1)
    assert fit.scene is not None
    assert fit.scene.tolist() == [[-2, -1, 0], [1.8, 1.0, 1.6]]
    assert json.loads(json.dumps(fit.record()))["misfits"] == []


@pytest.mark.parametrize(
    ("numbers", "taken", "unit", "factor"),
    [("mm", "m", "mm", 1000), ("mm", "in", "mm", 25.4), ("mm", "ft", "mm", 304.8)],
)
def test_a_tool_in_another_unit_is_named(
    numbers: str, taken: str, unit: str, factor: float
) -> None:
    length = 0.25 / UNITS[numbers] * UNITS[taken]
    fit = found(car(), wrench(length), along(*SLIDE), tool_unit=taken)
    (misfit,) = fit.misfits
    assert (misfit.what, misfit.unit) == ("tool", unit)
    assert misfit.factor == pytest.approx(factor)
    assert "millimetres, not" in misfit.text
    assert f"(factor {factor:g})" in misfit.text


@pytest.mark.parametrize(
    ("numbers", "taken"), [("mm", "m"), ("mm", "in"), ("in", "m"), ("cm", "m"), ("mm", "ft")]
)
@pytest.mark.parametrize("is_moving", [False, True])
def test_a_path_in_another_unit_is_named(numbers: str, taken: str, *, is_moving: bool) -> None:
    factor = UNITS[taken] / UNITS[numbers]
    path = along(*SLIDE, factor=factor)
    fit = found(car(), wrench(), path, path_unit=taken, is_moving=is_moving)
    (misfit,) = fit.misfits
    assert misfit.what == "path"
    assert misfit.unit == numbers
    assert misfit.factor == pytest.approx(factor)
    assert misfit.text.startswith("the path never comes within ")


def test_a_scene_in_millimetres_is_named_when_tool_and_path_agree() -> None:
    (misfit,) = found(car(1000.0), wrench(), along(*SLIDE)).misfits
    assert (misfit.what, misfit.unit) == ("scene", "mm")
    assert misfit.factor == pytest.approx(1000.0)


def test_a_path_elsewhere_is_told_without_a_unit() -> None:
    (misfit,) = found(car(), wrench(), along((0, 0, 50), (2, 0, 50))).misfits
    assert (misfit.what, misfit.unit, misfit.factor) == ("path", None, None)


def test_nothing_to_hit_is_told() -> None:
    fit = compare_proportions(car(), 0.01, wrench(), along(*SLIDE), exclude=range(1, 9))
    assert [misfit.what for misfit in fit.misfits] == ["scene"]
    assert (fit.scene, fit.gap) == (None, None)


# -- right sizes are not reported ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "shell", "path"),
    [
        (car(), wrench(), along((300, 0, 1), *SLIDE)),  # begins far away
        (car(), wrench(), along((-3, 0, 2.5), (3, 0, 2.5))),  # passes outside
        (car(), wrench(0.01), along(*SLIDE)),
        (car(), wrench(3.0), along(*SLIDE)),
        (car(), wrench(), along((0, 0, 1.6))),
        (car(), wrench(), None),
        (objects(((0, 0, 0), (0.005, 0.005, 0.001))), wrench(), along((0, 0, 0.3), (0, 0, 0.01))),
        (objects(((0, 0, 0), (0.005, 0.005, 0.001))), wrench(), along((0, 0, 0.2), (0.4, 0, 0.2))),
        (car(25.0), wrench(20.0), along(*SLIDE, factor=25.0)),  # a crane in a yard
    ],
)
def test_honest_work_raises_no_alarm(
    scene: list[Object], shell: PointShell, path: NDArray[np.float64] | None
) -> None:
    assert found(scene, shell, path).misfits == ()


def test_a_part_larger_than_what_is_left_is_no_misfit() -> None:
    """A hull that is lifted off its contents came from the scene, so its unit is the scene's."""
    hull, path = wrench(20.0), along((0, 0, 0), (0, 0, 2))
    assert [misfit.what for misfit in found(car(), hull, path).misfits] == ["tool"]
    assert found(car(), hull, path, tool_unit=None).misfits == ()


@pytest.mark.parametrize("length", [0.0001, 6.0])
def test_a_given_unit_of_the_tool_is_believed(length: float) -> None:
    """A tool smaller than a voxel, and one longer than the scene, which inches would fit."""
    shell, path = wrench(length), along(*SLIDE)
    assert [misfit.what for misfit in found(car(), shell, path).misfits] == ["tool"]
    assert found(car(), replace(shell, has_unit=True), path).misfits == ()


def test_a_given_unit_of_the_path_is_believed() -> None:
    """A long path is no misfit then. One elsewhere is, without another unit."""
    long, far = along(*SLIDE, (900, 0, 0)), along(*SLIDE, factor=1000.0)
    for path, misfits in ((long, []), (far, [("path", None)])):
        (misfit,) = found(car(), wrench(), path).misfits
        assert misfit.what == "path"
        fit = found(car(), wrench(), path, is_path_unit_given=True)
        assert [(one.what, one.unit) for one in fit.misfits] == misfits
    assert found(car(), wrench(), far).misfits[0].unit == "mm"


@pytest.mark.parametrize("known", [{"link": "a.step"}, {"attributes": {"unit": "m"}}])
def test_a_given_unit_of_the_scene_is_believed(known: dict[str, Any]) -> None:
    scene = [replace(obj, **known) for obj in car(1000.0)]
    assert "scene" not in [misfit.what for misfit in found(scene, wrench(), along(*SLIDE)).misfits]


def test_shells_of_files_know_whether_their_unit_was_given(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((6.0, 1.0, 1.0))
    for suffix in ("stl", "glb"):
        mesh.export(tmp_path / f"a.{suffix}")
    made = PointShell.from_file(tmp_path / "a.stl", 60)
    assert not made.has_unit
    assert PointShell.from_file(tmp_path / "a.stl", 60, unit="m").has_unit
    assert PointShell.from_file(tmp_path / "a.glb", 60).has_unit
    made.save(tmp_path / "a.npz")
    assert PointShell.from_file(tmp_path / "a.npz").has_unit


# -- the gap is a bound ----------------------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1), pairs=st.sampled_from([4, 100, 2_000_000]))
def test_no_point_of_the_tool_comes_nearer_than_the_gap(seed: int, pairs: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = [np.sort(rng.uniform(-1, 1, (2, 3)), axis=0) for _ in range(5)]
    scene = objects(*((tuple(low), tuple(high)) for low, high in boxes))
    sphere = PointShell.sphere(rng.uniform(0.01, 0.5), 40)
    shell = PointShell(sphere.points + rng.uniform(-1, 1, 3), sphere.normals, np.zeros(3))
    path = along(*rng.uniform(-4, 4, (6, 3)))
    turns = rng.normal(size=(6, 4))
    path[:, :3, :3] = rotation_of(turns / np.linalg.norm(turns, axis=1, keepdims=True))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hapticdb.proportions.PAIRS", pairs)
        gap = compare_proportions(scene, 0.01, shell, path).gap
    assert gap is not None
    middle = 0.5 * (shell.points.min(axis=0) + shell.points.max(axis=0))
    way = Way.of(path, shell.points, middle)
    for pose in way.at(np.append(way.ways, np.arange(0.0, way.length, 0.15))):
        points = shell.points @ pose[:3, :3].T + pose[:3, 3]
        for low, high in boxes:
            apart = np.maximum(np.maximum(low - points, points - high), 0)
            assert np.linalg.norm(apart, axis=1).min() >= gap - 1e-9


def test_wrong_paths_and_units_are_refused() -> None:
    with pytest.raises(UsageError, match="poses"):
        compare_proportions(car(), 0.01, wrench(), np.eye(4))
    with pytest.raises(UsageError, match="furlong"):
        found(car(), wrench(), along(*SLIDE, factor=1e6), path_unit="furlong")


# -- the command line ------------------------------------------------------------------------------


@pytest.mark.long
def test_a_large_tool_is_named_and_not_the_poses(run: Run, scene: Path) -> None:
    trimesh.creation.box((20.0, 20.0, 20.0)).export(scene.parent / "mm.stl")
    for args in (("touch", scene, "--poses"), ("sweep", scene, "--path")):
        code, _, err = run(*args, "path.csv", "--tool", "mm.stl")
        (line,) = err.splitlines()
        assert line.startswith("hapticdb: the tool is 20 m long, 40 times as long as the scene")
        assert line.endswith("(factor 1000); give --tool-unit mm if so")
        assert code == (0 if args[0] == "touch" else 1)  # the scene is inside the tool
        code, _, err = run(*args, "path.csv", "--tool", "mm.stl", "--tool-unit", "mm")
        assert (code, err) == (0 if args[0] == "touch" else 1, "")


def test_a_path_in_millimetres_is_no_proof(run: Run, scene: Path) -> None:
    poses(scene.parent / "mm.csv", (0, 0, 61), (200, 0, 300))
    args = ("sweep", scene, *TOOL, "--path", "mm.csv")
    code, out, err = run(*args)
    assert (code, out.startswith("clear ")) == (3, True)
    assert err.endswith("millimetres, not metres (factor 1000); give --path-unit mm if so\n")
    assert len(err.splitlines()) == 1
    code, out, _ = run(*args, "--json")
    assert code == 3
    record = json.loads(out)["proportions"]
    assert [(m["what"], m["unit"]) for m in record["misfits"]] == [("path", "mm")]
    assert run(*args, "--as-given")[0] == 0
    succeeded(run(*args, "--path-unit", "mm"))


def test_a_given_unit_is_never_overruled(run: Run, scene: Path) -> None:
    """A clear path is clear where the tool's unit, or the path's, was given."""
    trimesh.creation.box((6.0, 0.1, 0.1)).export(scene.parent / "beam.stl")
    poses(scene.parent / "above.csv", (0, 0, 0.3), (0.2, 0, 0.3))
    args = ("sweep", scene, "--tool", "beam.stl", "--path", "above.csv")
    code, _, err = run(*args)
    assert (code, "--tool-unit" in err) == (3, True)
    succeeded(run(*args, "--tool-unit", "m"))
    poses(scene.parent / "long.csv", (-60, 0, 0.3), (60, 0, 0.3))
    args = ("sweep", scene, *TOOL, "--path", "long.csv")
    assert run(*args)[0] == 3
    succeeded(run(*args, "--path-unit", "m"))


def test_touch_says_that_no_pose_is_near(run: Run, scene: Path) -> None:
    poses(scene.parent / "above.csv", (0, 0, 0.1))
    code, out, err = run("touch", scene, *TOOL, "--poses", "above.csv")
    assert (code, "0 hit" in out) == (0, True)
    assert err.startswith("hapticdb: no pose comes within 32.")
    assert err.endswith(" mm of the scene: nothing can be touched\n")
    poses(scene.parent / "mm.csv", (0, 0, 55), (200, 0, 300))
    code, out, err = run("touch", scene, *TOOL, "--poses", "mm.csv", "--json")
    assert (code, len(err.splitlines())) == (0, 1)
    assert [json.loads(line)["misfits"][0]["unit"] for line in out.splitlines()] == ["mm", "mm"]


def test_feel_says_what_does_not_fit(run: Run, scene: Path) -> None:
    poses(scene.parent / "mm.csv", (0, 0, 55), (200, 0, 300))
    args = ("feel", scene, *TOOL, "--device", "mm.csv", "--seconds", 0.1, "--rate", 200)
    code, out, err = run(*args, "--json")
    assert code == 0
    assert "(factor 1000); give --scale 0.001 if so" in err
    assert json.loads(out)["proportions"]["misfits"][0]["what"] == "path"
    assert "factor" not in run(*args, "--scale", 0.001)[2]
