"""The command line for a user: help and verbs, import, and its process."""

import inspect
import json
import os
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import hapticdb
import step_files
from children import child, finished
from command_line import Run, boxes, command, poses, refused, succeeded
from hapticdb import cli
from hapticdb.cli import options
from hapticdb.grid import CURVE_NAMES
from hapticdb.mesh import Part
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.query.law import LAWS
from hapticdb.session.coupling import RENDERINGS
from hapticdb.store import connect
from hapticdb.store.base import LAYOUTS
from hapticdb.units import UNITS

VERBS = [verb.__name__.rstrip("_") for verb in cli.VERBS]


# -- help and verbs -------------------------------------------------------------------------------


def test_main_without_arguments_lists_verbs(run: Run) -> None:
    out = succeeded(run())
    for verb in VERBS:
        assert re.search(rf"^\W*{verb}\s", out, re.MULTILINE), verb


@pytest.mark.parametrize(
    ("choices", "names"),
    [
        (options.StrategyName, STRATEGIES), (options.CurveName, CURVE_NAMES),
        (options.LayoutName, LAYOUTS), (options.LawName, LAWS), (options.RenderingName, RENDERINGS),
        (options.UnitName, UNITS),
    ],
)  # fmt: skip
def test_options_choices_equal_library(choices: object, names: Iterable[str]) -> None:
    assert set(get_args(choices)) == set(names)


def test_main_help_example_for_each_verb(run: Run) -> None:
    for verb in VERBS:
        out = succeeded(run(verb, "--help"))
        assert max(map(len, out.splitlines())) <= 80
        assert f"Example: hapticdb {verb}" in " ".join(out.split())


def test_main_version(run: Run) -> None:
    assert run("--version") == (0, f"hapticdb {hapticdb.__version__}\n", "")


def test_main_json_option_of_each_verb() -> None:
    commands = cli.app.registered_commands
    assert {getattr(one.callback, "__wrapped__", None) for one in commands} == set(cli.VERBS)
    without = [v.__name__ for v in cli.VERBS if "output" not in inspect.signature(v).parameters]
    # view and serve print no result, and serve logs as JSON by --log-json
    assert without == ["view", "serve", "demo", "sample"]


@pytest.mark.parametrize(
    ("args", "word"),
    [
        ("tuch", "'touch'"), ("import a.db", "missing argument"), ("info", "missing argument"),
        ("info a.db --jsn", "did you mean --json?"), ("touch a.db", "missing option"),
        ("import a.db b.glb --bits x", "--bits"), ("import a.db b.glb --unit yard", "--unit"),
    ],
)  # fmt: skip
def test_main_bad_command_line(run: Run, args: str, word: str) -> None:
    refused(run(*args.split()), word, "--help")


def test_main_debug_traceback(run: Run) -> None:
    code, _, err = run("--debug", "info", "none.db")
    assert code == 2
    assert "Traceback" in err
    assert err.splitlines()[-1].startswith("hapticdb: no environment at none.db")


def test_main_unexpected_error_one_line(
    run: Run, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise RuntimeError("first line\nsecond line")

    monkeypatch.setattr(connect, "open_store", fails)
    code, out, err = run("info", scene)
    assert (code, out) == (1, "")
    assert err == "hapticdb: RuntimeError: first line; 'hapticdb --debug ...' shows where\n"


LOADS = """
import sys
from hapticdb.cli import main

url, slow = sys.argv[1], {"numba", "scipy", "PIL", "trimesh", "cascadio", "psycopg"}
for args, others in (
    (["--version"], {"numpy", "apsw", "rich.table"}),
    (["--help"], {"numpy", "apsw"}),
    (["touch", "--help"], {"numpy", "apsw"}),
    (["info", url], {"hapticdb.environment"}),
    (["objects", url], {"hapticdb.environment"}),
):
    assert main(args) == 0
    assert not (slow | others) & {*sys.modules}, args
"""


def test_main_lazy_imports(scene: Path) -> None:
    finished([sys.executable, "-c", LOADS, str(scene)], check=True)


# -- import ---------------------------------------------------------------------------------------


def test_import_json_line_per_file(run: Run, tmp_path: Path) -> None:
    file = boxes(tmp_path / "boxes.glb")
    code, out, err = run("import", "a.db", file, "none.stl", "--json", "--bits", 5)
    assert code == 2
    good, bad = map(json.loads, out.splitlines())
    assert (good["status"], good["objects"], good["error"]) == ("imported", 3, None)
    assert good["chord_error"] == 0.0
    assert bad["status"] == "failed"
    assert "none.stl" in bad["error"]
    assert "none.stl" in err


def test_import_reports_chord_error_and_defects(run: Run, tmp_path: Path) -> None:
    file, small = step_files.cylinder(tmp_path / "a.step", 5, 10), ("--bits", 4)
    out = succeeded(run("import", "a.db", file, *small, "--chord", "0.1"))
    (chord,) = re.findall(r"chord error of its triangles: (\S+) µm", out)
    assert 40 < float(chord) < 100
    refused(run("import", "a.db", file), "--chord", "--replace")
    for chord in ("0", "-1", "1e-9", "2m", "nan", "", "1 furlong", "1e999"):
        refused(run("import", "c.db", file, "--chord", chord), "chord")
    assert not (tmp_path / "c.db").exists()
    mesh = tmp_path / "nan.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv nan 0 0\nf 1 2 3\nf 1 2 4\n")
    code, out, err = run("import", "d.db", mesh, *small, "--chord", "1")
    assert (code, "chord error" in out, "--chord changes nothing" in err) == (0, False, True)
    for words in ("1 object imported", "16^3 voxels", "1 non-finite"):
        assert words in out


def test_import_swapped_arguments(run: Run, tmp_path: Path) -> None:
    file = boxes(tmp_path / "boxes.glb")
    refused(run("import", "boxes.glb", "a.db"), "the environment is first: a.db boxes.glb")
    refused(run("import", file, tmp_path / "tool.stl"), "the environment is first")


def test_import_unsuitable_voxel_size_note(run: Run, tmp_path: Path) -> None:
    far = boxes(tmp_path / "far.glb", count=1, side=3000.0)
    hint = "voxels of 75 m are coarse: --bits 14 makes them 0.293 m"
    assert hint in run("import", "a.db", far, "--bits", 6)[2]
    tiny = boxes(tmp_path / "tiny.glb", count=1, side=3e-7)
    assert "is --unit right?" in run("import", "b.db", tiny, "--bits", 6)[2]


def test_import_negative_origin(run: Run, tmp_path: Path) -> None:
    form = ("--origin", "-1,-2,-0.5", "--voxel-size", 0.05, "--bits", 7)
    succeeded(run("import", "a.db", boxes(tmp_path / "boxes.glb"), *form))
    assert json.loads(run("info", "a.db", "--json")[1])["origin"] == [-1, -2, -0.5]


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ("--bits 22", "22 bits"), ("--bits 5 --extent 2 --voxel-size 0.1", "contradict"),
        ("--curve lexicographic", "hierarchical"), ("--origin 1,2", "--origin"),
        ("--origin 1,2,nan", "--origin"), ("--jobs 0", "jobs"),
    ],
)  # fmt: skip
def test_import_bad_options(run: Run, tmp_path: Path, options: str, word: str) -> None:
    refused(run("import", "a.db", boxes(tmp_path / "boxes.glb"), *options.split()), word)
    assert not (tmp_path / "a.db").exists()


def test_main_missing_environment(run: Run) -> None:
    for verb in (("info",), ("objects",), ("info", "--calibrate")):
        refused(run(*verb, "none.db"), "no environment at none.db", "hapticdb import")


# -- as a process ---------------------------------------------------------------------------------


def test_touch_broken_pipe(scene: Path, tmp_path: Path) -> None:
    poses(tmp_path / "long.csv", *[(0.0, 0.0, 0.055)] * 2000)
    args = command("touch", scene, "--tool", "tool.npz", "--poses", "long.csv", "--json")
    with child(args, cwd=tmp_path) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline().startswith("{")
        process.stdout.close()
        assert process.stderr.read() == ""


def test_distance_line_break_in_name_escaped(run: Run, scene: Path) -> None:
    corners = np.array([[1.0, 0.0, 0.0], [1.1, 0.0, 0.0], [1.0, 0.1, 0.0]])
    part = Part("up\ndown\x1b[31m", corners, np.array([[0, 1, 2]]), np.eye(4))
    with hapticdb.open(scene) as env:
        place = 0.5 * env.grid.bounds.sum(axis=0)
        part.world_from_part[:3, 3] = place - (1.0, 0.0, 0.0)
        (added,) = env.add(part).added
    out = succeeded(run("distance", scene, "box0", added.id))
    assert out.startswith("box0 and up\\ndown\\x1b[31m ")
    assert len(out.splitlines()) == 3


def test_objects_names_beyond_terminal_encoding(run: Run, tmp_path: Path) -> None:
    (tmp_path / "ä.obj").write_text("o é\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "utf-8")
    succeeded(run("import", "ä.db", "ä.obj", "--bits", 4))
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = finished(command("objects", "ä.db"), cwd=tmp_path, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert re.search(r"^-+$", done.stdout, re.MULTILINE)
