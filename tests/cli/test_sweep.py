"""The verb sweep, with right and wrong arguments."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import json
import os
import signal
from pathlib import Path

import matplotlib.image
import pytest

import hapticdb
from children import finished
from command_line import Run, boxes, command, made, poses, refused, run, scene  # noqa: F401 - fixtures
from hapticdb.cli.csv_files import SWEPT
from hapticdb.sweeps import run as sweeping

TOOL = ("--tool", "tool.stl")


@pytest.fixture
def free(scene: Path) -> Path:
    """A path above the boxes."""
    return poses(scene.parent / "free.csv", (0.0, 0.0, 0.1), (0.4, 0.0, 0.1))


@pytest.fixture
def through(scene: Path) -> Path:
    """A path from above into the first box and on through all of them."""
    return poses(
        scene.parent / "through.csv", (-0.05, 0.0, 0.15), (-0.05, 0.0, 0.0), (0.45, 0.0, 0.0)
    )


@pytest.mark.usefixtures("free")
def test_what_comes_out_is_said_with_its_clearance(run: Run, scene: Path) -> None:
    code, out, err = run("sweep", scene, *TOOL, "--path", "free.csv")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].startswith("comes out: no hit in ")
    # voxels of 12.5 mm: a box's voxels end at 62.5 mm, the tool begins at 90 mm
    assert lines[0].endswith(", least clearance 27.5 mm from box0")
    assert any(line.startswith("clearance") and "the surfaces are" in line for line in lines)
    assert any(
        line.startswith("tool") and "none of its surface more than" in line for line in lines
    )


@pytest.mark.usefixtures("through")
def test_what_is_caught_is_said_with_where_and_by_what(run: Run, scene: Path) -> None:
    code, out, err = run("sweep", scene, *TOOL, "--path", "through.csv")
    assert (code, err) == (1, "")
    first, *rest = out.splitlines()
    assert first.startswith("is caught: first contact at ")
    assert "(segment 0) with box0" in first
    assert [name for name in ("box0", "box1", "box2") if any(name in line for line in rest)] == [
        "box0", "box1", "box2",
    ]  # fmt: skip


def test_what_is_not_decided_has_a_code_of_its_own(run: Run, scene: Path) -> None:
    """The tool ends 5 mm above a box's voxels, and its 40 points are more than 5 mm apart."""
    poses(scene.parent / "near.csv", (0.0, 0.0, 0.0775), (0.005, 0.0, 0.0775))
    few = ("--points", 40)
    code, out, err = run("sweep", scene, *TOOL, "--path", "near.csv", *few)
    assert (code, err) == (3, "")
    verdict = out.splitlines()[0]
    assert verdict.startswith("not decided: no hit in ")
    assert "a voxel of box0 comes within 5 mm of a point" in verdict
    n_points = verdict.rpartition("--points ")[2].rstrip(")")
    code, out, _ = run("sweep", scene, *TOOL, "--path", "near.csv", "--points", n_points)
    assert (code, out[:9]) == (0, "comes out")
    found = json.loads(run("sweep", scene, *TOOL, "--path", "near.csv", *few, "--json")[1])
    assert (found["verdict"], found["comes_out"]) == ("not decided", False)
    assert found["proof"]["cover"] > found["proof"]["nearest"] > found["proof"]["cover_needed"]


def test_a_saved_shell_is_told_what_it_lacks(run: Run, scene: Path) -> None:
    poses(scene.parent / "free.csv", (0.0, 0.0, 0.1), (0.4, 0.0, 0.1))
    hapticdb.PointShell.from_file(scene.parent / "tool.stl", 2000).save(scene.parent / "tool.npz")
    code, out, _ = run("sweep", scene, "--tool", "tool.npz", "--path", "free.csv")
    assert code == 3
    assert "how well the points cover the tool is not known: give its mesh" in out.splitlines()[0]


@pytest.mark.usefixtures("through")
def test_sweep_json_has_the_documented_keys(run: Run, scene: Path) -> None:
    code, out, err = run("sweep", scene, *TOOL, "--path", "through.csv", "--json", "--points", 50)
    assert (code, err) == (1, "")
    found = json.loads(out)
    assert set(found) == {
        "verdict", "comes_out", "line", "proof", "poses", "samples", "hits", "contacts",
        "first_hit", "first_contact", "deepest", "objects", "enclosed", "hit_intervals",
        "contact_intervals", "clearance", "tool", "revision", "elapsed", "cells", "proportions",
        "at_least", "looked", "left_at_start", "decision", "depths",
    }  # fmt: skip
    assert set(found["first_contact"]) == {"sample", "fraction", "segment", "pose", "objects"}
    assert set(found["deepest"]) == {"depth", "point", "moment"}
    assert set(found["clearance"]) == {
        "distance", "at_least", "at_most", "is_beyond", "point", "voxel", "moment",
    }  # fmt: skip
    assert set(found["objects"][0]) == {
        "id", "name", "first", "last", "intervals", "first_contact", "length", "samples",
        "contacts", "points", "deepest",
    }  # fmt: skip
    assert (found["comes_out"], found["poses"], found["tool"]["points"]) == (False, 3, 50)
    assert found["clearance"]["distance"] == 0.0


@pytest.mark.usefixtures("scene")
def test_what_the_tool_touches_at_its_start_is_left_out_and_named(run: Run, scene: Path) -> None:
    poses(scene.parent / "up.csv", (0.0, 0.0, 0.055), (0.0, 0.0, 0.2))
    up = ("sweep", scene, *TOOL, "--path", "up.csv", "--leave-start")
    code, out, _ = run(*up)
    assert code == 0
    assert "; left out, since touched at the start: box0; in box0 " in out.splitlines()[0]
    found = json.loads(run(*up, "--json")[1])
    assert [one["name"] for one in found["depths"]] == ["box0"]
    assert [one["name"] for one in found["left_at_start"]] == ["box0"]
    assert found["tool"]["excluded"] == []


def test_nothing_comes_out_of_what_it_may_cut(run: Run, scene: Path) -> None:
    """The file of what the tool touches at its start is gone: it is not known how deep it goes."""
    file = boxes(scene.parent / "own.glb")
    assert run("import", "own.db", file, "--bits", 6)[0] == 0
    file.unlink()
    poses(scene.parent / "up.csv", (0.0, 0.0, 0.055), (0.0, 0.0, 0.2))
    up = ("sweep", "own.db", *TOOL, "--path", "up.csv", "--leave-start")
    code, out, _ = run(*up)
    assert code == 3
    assert "comes out" not in out
    line = out.splitlines()[0]
    assert line.startswith("not decided: meets nothing else, but how deep it goes into box0 ")
    code, out, _ = run(*up, "--json")
    assert (code, json.loads(out)["verdict"], json.loads(out)["line"]) == (3, "not decided", line)


@pytest.mark.usefixtures("through")
def test_a_hit_is_told_only_within_the_tolerance(run: Run, scene: Path) -> None:
    sweep = ("sweep", scene, *TOOL, "--path", "through.csv", "--json", "--tolerance")
    code, out, _ = run(*sweep, 10)
    decision = json.loads(out)["decision"]
    assert (code, decision["is_near"]) == (1, True)
    assert decision["within"] <= decision["tolerance"] == 0.01
    code, out, _ = run(*sweep, 1e-6)
    found = json.loads(out)
    assert (code, found["verdict"], found["decision"]["is_near"]) == (3, "not decided", False)
    assert found["line"].startswith("not decided below ")
    assert "grazes box0" in found["line"]


def test_a_finer_shell_decides_by_itself(run: Run, scene: Path) -> None:
    """Few points at first, and the tool starts 5 mm above a box's voxels."""
    poses(scene.parent / "near.csv", (0.0, 0.0, 0.0775), (0.0, 0.0, 0.2))
    near = ("sweep", scene, *TOOL, "--path", "near.csv", "--points", 6)
    assert run(*near)[0] == 3
    code, out, _ = run(*near, "--refine")
    assert (code, out[:24]) == (0, "comes out with at least ")
    decision = json.loads(run(*near, "--refine", "--json")[1])["decision"]
    assert decision["is_clear"]
    assert 0.0 < decision["at_least"] <= 0.0175 + 1e-9  # the boxes' surfaces are so far apart


@pytest.mark.usefixtures("through")
def test_a_sweep_is_written_as_csv(run: Run, scene: Path) -> None:
    sweep = ("sweep", scene, *TOOL, "--path", "through.csv")
    found = json.loads(run(*sweep, "--json")[1])
    assert run(*sweep, "--csv", "hit.csv")[0] == 1
    text = scene.with_name("hit.csv").read_text()
    header, *rows = [line.split(",") for line in text.splitlines()]
    assert tuple(header) == SWEPT
    assert [(row[1], float(row[2]), float(row[3])) for row in rows] == [
        (one["name"], *interval) for one in found["objects"] for interval in one["intervals"]
    ]
    code, out, err = run(*sweep, "--csv", "-")
    assert (code, out, err) == (1, text, "")
    refused(run(*sweep, "--csv", "-", "--json"), "only one")
    refused(run(*sweep, "--csv", "hit.csv"), "--csv")
    refused(run(*sweep, "--tolerance", 0), "tolerance")


@pytest.mark.long
@pytest.mark.usefixtures("free")
def test_the_picture_is_drawn_although_nobody_reads_on(scene: Path) -> None:
    args = command("sweep", scene.name, *TOOL, "--path", "free.csv", "--picture", "out.png")
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = finished(args, cwd=scene.parent, stdout=writing)
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")
    assert matplotlib.image.imread(scene.parent / "out.png").shape[:2] == (1000, 1600)


@pytest.mark.usefixtures("free")
def test_others_who_write_meanwhile_are_told_of(
    run: Run, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swept_by = sweeping.sweep

    def disturbed(*args: object, **options: object) -> object:
        found = swept_by(*args, **options)  # type: ignore[arg-type]
        with hapticdb.open(scene) as env:
            env.remove(3)
        return found

    monkeypatch.setattr(sweeping, "sweep", disturbed)
    code, _, err = run("sweep", scene, *TOOL, "--path", "free.csv")
    assert code == 0
    assert "was written meanwhile; this is of revision 3" in err


@pytest.mark.usefixtures("free")
@pytest.mark.parametrize("name", ["scene.db", ".png"])
def test_a_picture_that_is_none_by_its_name_overwrites_nothing(
    run: Run, scene: Path, name: str
) -> None:
    before = {path.name: path.read_bytes() for path in scene.parent.iterdir()}
    refused(run("sweep", scene, *TOOL, "--path", "free.csv", "--picture", name), "--picture")
    assert {path.name: path.read_bytes() for path in scene.parent.iterdir()} == before


@pytest.mark.parametrize("place", [(5000.0, 0.0, 0.0), (1e8, 1e8, 1e8)])
def test_a_path_beside_the_environment_is_told(
    run: Run, scene: Path, place: tuple[float, float, float]
) -> None:
    poses(scene.parent / "mm.csv", place, (place[0] + 0.1, *place[1:]))
    code, out, err = run("sweep", scene, *TOOL, "--path", "mm.csv")
    assert (code, out.startswith("comes out: ")) == (3, True)
    (line,) = err.splitlines()
    assert line.startswith("hapticdb: the path never comes within ")


def test_wrong_use_of_sweep_is_one_line(run: Run, scene: Path) -> None:
    path = ("--path", "path.csv")
    refused(run("sweep", scene, *path), "--tool and --part")
    refused(run("sweep", scene, *path, *TOOL, "--part", 1), "--tool and --part")
    refused(run("sweep", scene, *path, "--part", 1, "--tool-unit", "mm"), "--tool-unit")
    refused(run("sweep", scene, *path, "--part", 9), "no object 9")
    refused(run("sweep", scene, *path, *TOOL, "--exclude", "9"), "no object 9")
    refused(run("sweep", scene, *path, *TOOL, "--exclude", "x"), "--exclude")
    refused(run("sweep", scene, *path, *TOOL, "--budget", 0.5), "--budget")
    refused(run("sweep", scene, *path, *TOOL, "--clearance", -1), "clearance")
    refused(run("sweep", scene, *path, *TOOL, "--picture", "no/folder.png"), "cannot write")
    refused(run("sweep", scene, *path, *TOOL, "--clearance", 1e300), "up to 1e+300 m needs more")
    refused(run("sweep", scene, "--path", "none.csv", *TOOL), "no file of poses")
    refused(run("sweep", "none.db", *path, *TOOL), "none.db")
