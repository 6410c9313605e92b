"""The verbs info to touch on a small environment, with right and wrong arguments."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import hapticdb
from command_line import Run, poses, refused, rows_of, succeeded, tool
from hapticdb.paper.strategies import STRATEGIES

Scene = Path | str
"""A path or a URL: a file in this module; cli/test_postgres.py runs the same tests on servers."""

# -- info, objects -------------------------------------------------------------------------------


def test_info_json_equals_library(run: Run, scene: Scene) -> None:
    found = json.loads(succeeded(run("info", scene, "--json")))
    with hapticdb.open(scene, read_only=True) as env:
        assert found["voxels"] == sum(len(env.voxels(obj.id)) for obj in env.objects())
        assert (found["voxel_size"], found["bits"]) == (env.grid.voxel_size, 6)
        assert (found["name"], found["engine"]) == (env.name, env.engine)
        assert found["bytes"] == env.size().bytes > 0
    assert found["statistics"] == {"source": "kept", "revision": 3, "changes": 0}
    assert (found["curve"], found["layout"], found["objects"]) == ("z", "brick", 3)


def test_info_text(run: Run, scene: Scene) -> None:
    out = succeeded(run("info", scene))
    assert "262,144 cells" in out
    assert "a voxel)" in out
    assert re.search(r"^engine +(SQLite|PostgreSQL) \d+\.\d+", out, re.MULTILINE)
    assert re.search(r"^statistics +computed and kept; fresh$", out, re.MULTILINE)


def test_info_renews_statistics_after_many_edits(run: Run, scene: Scene) -> None:
    """Of 3 objects each edit is many; a store alone counts what passes."""
    with hapticdb.open(scene) as env:
        env.store.remove(2)
    assert "1 write behind" in run("info", scene)[1]
    assert run("move", scene, 3, "--translate", "0,0,0.01")[0] == 0
    found = json.loads(run("info", scene, "--json")[1])["statistics"]
    assert (found["source"], found["changes"]) == ("kept", 0)


def test_objects_ordered_by_id(run: Run, scene: Scene) -> None:
    out = succeeded(run("objects", scene, "--json"))
    found = [json.loads(line) for line in out.splitlines()]
    assert [(obj["id"], obj["name"]) for obj in found] == [(1, "box0"), (2, "box1"), (3, "box2")]
    assert np.allclose(np.diff(found[0]["bounds"], axis=0), 0.1)
    table = run("objects", scene)[1]
    assert re.search(r"2\s+box1\s+\d+\s+100 x 100 x 100\s+boxes.glb", table)


def test_info_calibrate_spread(run: Run, scene: Scene) -> None:
    with hapticdb.open(scene) as env:
        env.store.remove(2)
    found = json.loads(succeeded(run("info", scene, "--calibrate", "--json")))
    assert found["statistics"]["changes"] == 0
    assert found["costs"]["is_kept"] is True
    costs = [found["costs"]["figures"][name] for name in ("statement", "descent", "block", "row")]
    assert min(costs) >= 0.0 < sum(costs)
    assert set(found["costs"]["spread"]) < set(found["costs"]["figures"])
    assert "±" in run("info", scene, "--calibrate")[1]
    refused(run("info", scene, "--cold"), "--calibrate")


def test_distance_nearest_pair(run: Run, scene: Scene) -> None:
    out = succeeded(run("distance", scene, "box0", "box*"))
    assert out.startswith("box0 and box1 are 100 mm apart\non box0  (0.05, ")
    refused(run("distance", scene, "box0", "bix1"), "did you mean 'box1'")


# -- move, remove ---------------------------------------------------------------------------------


def bounds_of(scene: Scene, object_id: int) -> Any:  # noqa: ANN401 - an array
    with hapticdb.open(scene, read_only=True) as env:
        return env.object(object_id).bounds


def test_move_translate_relative_matrix_absolute(run: Run, scene: Scene) -> None:
    before = bounds_of(scene, 2)
    for n in (1, 2):
        out = succeeded(run("move", scene, 2, "--translate", "-0.01,0,0.02"))
        assert "box1" in out
        assert np.allclose(bounds_of(scene, 2), before + n * np.array([-0.01, 0, 0.02]))
    lines = "1 0 0 0.3\n0 1 0 0.05\n0 0 1 0\n0 0 0 1\n"
    for given in (lines, "1,0,0,.3,0,1,0,.05,0,0,1,0,0,0,0,1"):
        code, out, _ = run("move", scene, 1, "--matrix", given, "--json")
        assert code == 0
        assert np.allclose(np.mean(json.loads(out)["bounds"], axis=0), (0.3, 0.05, 0))


def test_move_bad_arguments_change_nothing(run: Run, scene: Scene) -> None:
    before = rows_of(scene)
    for args, word in (
        ("1", "give one of"), ("1 --translate 1,2,3 --matrix 1", "give one of"),
        ("1 --translate 1,2", "--translate"), ("1 --matrix 1,0,0", "16 numbers"),
        ("1 --translate 50,0,0", "outside the grid"), ("9 --translate 0,0,0", "no object 9"),
    ):  # fmt: skip
        refused(run("move", scene, *args.split()), word)
    assert rows_of(scene) == before


# -- touch ----------------------------------------------------------------------------------------


def touch(run: Run, scene: Scene, *more: object) -> tuple[int, str, str]:
    return run("touch", scene, "--tool", "tool.npz", "--poses", "path.csv", *more)


def test_touch_json_line_per_pose(run: Run, scene: Scene) -> None:
    code, out, err = touch(run, scene, "--json", "--strategy", "cbgroup")
    assert (code, err) == (0, "")
    found = [json.loads(line) for line in out.splitlines()]
    assert [frame["pose"] for frame in found] == [0, 1, 2]
    assert found[0]["touched"] == [{"id": 1, "name": "box0"}]
    assert found[2]["touched"] == [{"id": 2, "name": "box1"}]
    assert found[1]["force"] == [0, 0, 0]
    assert found[0]["hits"] >= found[0]["contacts"] > 0
    twice = json.loads(touch(run, scene, "--json", "--stiffness", 2000)[1].splitlines()[0])
    assert np.allclose(2 * np.array(found[0]["force"]), twice["force"])


def test_touch_saved_shell(run: Run, scene: Scene) -> None:
    saved = touch(run, scene, "--json")[1].splitlines()
    meshed = touch(run, scene, "--json", "--tool", "tool.stl", "--conservative")[1].splitlines()
    for one, other in zip(saved, meshed, strict=True):
        assert one.split('"query"')[0] == other.split('"query"')[0]
    refused(touch(run, scene, "--points", 9), "saved shell")
    refused(touch(run, scene, "--tool-unit", "mm"), "saved shell")


def test_touch_open_tool_warning_and_unit(run: Run, scene: Scene, tmp_path: Path) -> None:
    tool(tmp_path / "open.stl", is_open=True)
    code, out, err = run("touch", scene, "--tool", "open.stl", "--poses", "path.csv", "--json")
    assert (code, len(out.splitlines())) == (0, 3)
    assert "inside is a guess" in err
    cube = trimesh.creation.box((20.0, 20.0, 20.0))
    (tmp_path / "mm.stl").write_bytes(cube.export(file_type="stl"))
    args = ("touch", scene, "--tool", "mm.stl", "--poses", "path.csv", "--json")
    assert json.loads(run(*args, "--tool-unit", "mm")[1].splitlines()[0])["hits"] > 0
    assert json.loads(run(*args)[1].splitlines()[0])["hits"] == 0


def test_touch_text_summary(run: Run, scene: Scene) -> None:
    code, out, err = touch(run, scene)
    assert (code, err) == (0, "")
    assert re.search(r"frames\s+3: 2 hit, 2 in contact", out)
    assert "N at pose" in out
    assert "box1" in out


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ("--exclude 77", "no object 77"), ("--strategy guess", "--strategy"),
        ("--maxgap -1 --strategy maxgap", "MAXGAP"), ("--stiffness nan", "stiffness"),
        ("--points 0 --tool tool.stl", "points"), ("--seed -1 --tool tool.stl", "seed"),
        ("--tool none.stl", "none.stl"), ("--poses none.csv", "none.csv"),
    ],
)  # fmt: skip
def test_touch_bad_arguments(run: Run, scene: Scene, options: str, word: str) -> None:
    refused(touch(run, scene, *options.split()), word)


def test_touch_uncalibrated_costs_use_array(run: Run, scene: Path) -> None:
    args = ("touch", scene, "--tool", "tool.npz", "--poses", "path.csv", "--json")
    used = {json.loads(line)["query"]["strategy"] for line in run(*args)[1].splitlines()}
    assert used == {"array"}
    assert run("info", scene, "--calibrate")[0] == 0
    used = {json.loads(line)["query"]["strategy"] for line in run(*args)[1].splitlines()}
    assert used <= set(STRATEGIES)


# -- names with control characters -----------------------------------------------------------------

UNWANTED = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
SPITEFUL = ("bell\x07\x1b[2J\x1b]0;owned", "gnp.\u202eexe", "\x9b31mred", "isolated\u2066\u2069")


def test_main_escapes_control_characters_in_names(run: Run, tmp_path: Path) -> None:
    """Names of parts in files and databases, and of files, in results and in errors."""
    lines = []
    for n, name in enumerate(SPITEFUL):
        corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
        lines += [f"o {name}", *(f"v {x + 2 * n} {y} {z}" for x, y, z in corners)]
        lines += [f"f {a + 4 * n} {b + 4 * n} {c + 4 * n}" for a, b, c in ((1, 3, 2), (1, 2, 4))]
    file = tmp_path / "pa\x1b[31mrts.obj"
    file.write_text("\n".join([*lines, ""]))
    tool(tmp_path / "tool.stl")
    poses(tmp_path / "path.csv", (0.02, 0.02, 0.0))
    said = []
    for args in (
        ("import", "a.db", file, "--bits", 6),
        ("import", "a.db", file, "no\x1b[31m.obj"),
        ("objects", "a.db"),
        ("objects", "a.db", "--json"),
        ("touch", "a.db", "--tool", "tool.stl", "--poses", "path.csv"),
        ("move", "a.db", 1, "--translate", "0.1,0,0"),
        ("remove", "a.db", 1),
        ("info", "no\x1b[31m\u202e.db"),
        ("--debug", "info", "no\x1b[31m\u202e.db"),
        ("touch", "a.db", "--\x1b[31m"),
    ):
        _, out, err = run(*args)
        assert not UNWANTED.search(out + err)
        said.append(out + err)
    for shown in (r"gnp.\u202eexe", r"isolated\u2066\u2069", r"pa\x1b[31mrts.obj"):
        assert shown in said[2]
    assert said[6].startswith("removed 1 (bell")
