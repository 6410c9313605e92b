"""Every verb has --json: standard output is JSON alone, whatever goes to standard error."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import inspect
import json
from pathlib import Path

import pytest

from command_line import Run, made, run, scene  # noqa: F401 - fixtures
from hapticdb.cli import VERBS, app
from hapticdb.kernels.compiling import NAMES
from hapticdb.store import connect


def test_every_verb_has_json() -> None:
    assert {command.callback for command in app.registered_commands} == set(VERBS)
    without = [verb.__name__ for verb in VERBS if "json" not in inspect.signature(verb).parameters]
    assert without == ["view", "serve"]  # they print no result, and log as JSON by --log-json


def test_sample_names_what_it_has_written(run: Run, tmp_path: Path, scene: Path) -> None:
    code, out, err = run("sample", "s", "--frames", 20, "--json")
    assert (code, err) == (0, "")
    assert json.loads(out) == {"files": ["s/car.glb", "s/wrench.stl", "s/path.csv"], "poses": 20}
    assert all((tmp_path / file).is_file() for file in json.loads(out)["files"])
    code, out, _ = run("sample", "t", "--along", scene, "--frames", 10, "--json")
    assert (code, json.loads(out)["files"]) == (0, ["t/wrench.stl", "t/path.csv"])


def test_grant_names_the_right(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[object] = []
    monkeypatch.setattr(connect, "grant", lambda *words: given.append(words))
    url = "postgresql://me:secret@host/plant"
    code, out, err = run("grant", url, "anna", "--as", "editor", "--json")
    assert (code, err, given) == (0, "", [(url, "anna", "editor")])
    found = json.loads(out)
    assert list(found) == ["environment", "role", "right"]
    assert (found["role"], found["right"]) == ("anna", "editor")
    assert "secret" not in out


def test_warm_counts_kernels(run: Run) -> None:
    code, out, _ = run("warm", "--json")
    found = json.loads(out)
    assert (code, list(found)) == (0, ["kernels", "compiled", "elapsed"])
    assert found["kernels"] == len(NAMES)
    assert json.loads(run("warm", "--json")[1])["compiled"] == 0


def test_remove_names_what_is_gone(run: Run, scene: Path) -> None:
    code, out, err = run("remove", scene, "1,3", "--json")
    assert (code, err) == (0, "")
    found = [json.loads(line) for line in out.splitlines()]
    assert [(obj["id"], obj["name"]) for obj in found] == [(1, "box0"), (3, "box2")]
    left = [json.loads(line) for line in run("objects", scene, "--json")[1].splitlines()]
    assert list(left[0]) == list(found[0])


@pytest.mark.long
def test_demo_has_the_figures_of_every_strategy(run: Run) -> None:
    args = ("demo", "d", "--bits", 6, "--frames", 20, "--points", 50, "--json")
    code, out, _ = run(*args)
    found = json.loads(out)
    assert code == 0
    assert list(found) == [
        *("files", "points", "poses", "layouts", "frames_compared", "frames_disagreed", "picture"),
    ]
    assert [one["layout"] for one in found["layouts"]] == ["brick", "voxel"]
    for one in found["layouts"]:
        assert one["voxels"] > 0
        for felt in one["strategies"].values():
            assert list(felt) == ["median_us", "p99_us", "statements", "ranges", "rows", "used"]
    assert Path(found["picture"]).is_file()
