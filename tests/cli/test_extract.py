"""The verb extract, with right and wrong arguments."""

import json
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from command_line import Run, refused, succeeded
from disassembly_scenes import CHAIN, STACK
from disassembly_scenes import made as made_of
from extraction_scenes import enclosed, lid
from hapticdb.poses import write_poses


def test_extract_path_confirmed_by_sweep(run: Run, scene: Path) -> None:
    """Three boxes in a row, 0.1 m apart: the middle one comes out to the side."""
    words = ("--motions", 0, "--out", 100)
    out = succeeded(run("extract", scene, "box1", *words, "--path", "out.csv"))
    lines = out.splitlines()
    assert lines[0].startswith("comes out straight, 0.1 m, surfaces ")
    assert lines[-1].split() == ["path", "out.csv"]
    poses = hapticdb.read_poses("out.csv")
    assert np.array_equal(poses[0], np.eye(4))
    assert np.linalg.norm(poses[-1][:3, 3]) == pytest.approx(0.1)
    code, out, _ = run("sweep", scene, "--part", "box1", "--path", "out.csv")
    assert (code, out[:5]) == (0, "clear")


def test_extract_json_documented_keys(run: Run, tmp_path: Path) -> None:
    out = succeeded(run("extract", lid(tmp_path, 0.0), "lid", "--motions", 0, "--json"))
    found = json.loads(out)
    assert list(found) == [
        "line", "verdict", "parts", "to", "path", "near", "blockers", "pulls", "motions", "queries",
        "is_planned", "is_out_of_time", "elapsed", "seed",
    ]  # fmt: skip
    assert set(found["path"]) == {"how", "poses", "length", "gap", "proof"}
    assert (found["verdict"], found["path"]["how"]) == ("comes out", "pull")
    (touched,) = found["path"]["proof"]["touching"]
    assert (touched["name"], touched["start"]) == ("pot", 5e-5)
    assert [obj["name"] for obj in found["near"]] == ["pot"]


def test_extract_goal_pose_numbers_or_file(run: Run, scene: Path) -> None:
    out = succeeded(run("extract", scene, "box1", "--to", "0,0,30cm,1,0,0,0", "--path", "to.csv"))
    assert out.startswith("reaches the pose straight, 0.3 m, ")
    goal = hapticdb.read_poses("to.csv")[-1:]
    assert np.allclose(goal[0, :3, 3], [0.0, 0.0, 0.3])
    write_poses("goal.csv", goal)
    code, out, _ = run("extract", scene, "box1", "--to", "goal.csv", "--json")
    assert (code, json.loads(out)["to"]) == (0, goal[0].tolist())


def test_extract_blockers_table(run: Run, tmp_path: Path) -> None:
    url = enclosed(tmp_path)
    code, out, err = run("extract", url, "block", "--motions", 0, "--path", "out.csv")
    assert (code, err) == (1, "")
    first, heading, _, row, *_ = [line for line in out.splitlines() if line]
    assert first.startswith("no path found in ")
    assert "cage blocks" in first
    assert heading.split() == ["id", "in", "the", "way", "of", "pulls"]
    assert row.split()[1] == "cage"
    assert not Path("out.csv").exists()
    found = json.loads(run("extract", url, "block", "--motions", 0, "--json")[1])
    assert (found["path"], found["blockers"][0]["name"]) == (None, "cage")
    to = ("--to", "0,0,500,1,0,0,0", "--motions", 0, "--json")
    found = json.loads(run("extract", url, "block", *to)[1])
    assert 1 < found["blockers"][0]["pulls"] <= found["pulls"]


def test_extract_bad_arguments(run: Run, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused(run("extract", scene, "nut"), "WORDS: no object 'nut'")
    refused(run("extract", scene), "WORDS")
    refused(run("extract", "missing.db", "box0"), "missing.db")
    refused(run("extract", scene, "box0", "--to", "0,0,1"), "--to '0,0,1'")
    refused(run("extract", scene, "box0", "--to", "0,0,1,0,0,0,0"), "no rotation")
    refused(run("extract", scene, "box0", "--to", "0,0,1,1,0,0,0", "--out", 1), "--out")
    refused(run("extract", scene, "box0", "--depth", 2), "--disassemble")
    refused(run("extract", scene, "box0", "--disassemble", "--depth", -1), "depth -1")
    refused(run("extract", scene, "box0", "--disassemble", "--keep", "nut"), "--keep: no object")
    refused(run("extract", scene, "box0", "--animation", "a.gif"), ".html")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    refused(run("extract", scene, "box0", "--animation", "a.html"), "'viser")


@pytest.mark.long
def test_extract_disassemble_writes_each_step(run: Run, tmp_path: Path) -> None:
    url = made_of(tmp_path, STACK)
    words = ("--disassemble", "--keep", "pot", "--motions", 0)
    out = succeeded(run("extract", url, "lid", *words, "--path", "off.csv"))
    lines = out.splitlines()
    assert lines[0].startswith("after weight: comes out straight, ")
    assert [line.partition(":")[0] for line in lines[1:3]] == ["1. weight", "2. lid"]
    assert "off-1.csv ... off-2.csv" in out
    assert run("sweep", url, "--part", "weight", "--path", "off-1.csv")[0] == 0
    assert run("sweep", url, "--part", "lid", "--path", "off-2.csv")[0] == 1  # meets the weight
    excluded = ("--exclude", "weight")
    assert run("sweep", url, "--part", "lid", "--path", "off-2.csv", *excluded)[0] == 0


def test_extract_disassemble_json_proof_per_step(run: Run, tmp_path: Path) -> None:
    url = made_of(tmp_path, STACK)
    words = ("--disassemble", "--keep", "pot", "--motions", 0, "--json")
    code, out, _ = run("extract", url, "lid", *words)
    found = json.loads(out)
    assert code == 0
    assert list(found) == [
        "line", "verdict", "parts", "steps", "failed", "is_out_of_time", "elapsed", "seed",
    ]  # fmt: skip
    assert [step["parts"][0]["name"] for step in found["steps"]] == ["weight", "lid"]
    assert [step["path"]["proof"]["verdict"] for step in found["steps"]] == ["clear"] * 2
    assert [len(step["excluded"]) for step in found["steps"]] == [1, 2]
    assert found["failed"][0]["blockers"][0].keys() == {"id", "name", "pulls"}


def test_extract_disassemble_blocked_table(run: Run, tmp_path: Path) -> None:
    url = made_of(tmp_path, CHAIN)
    words = ("--disassemble", "--motions", 0, "--path", "off.csv", "--animation", "off.html")
    code, out, err = run("extract", url, "left", *words)
    assert (code, err) == (1, "")
    first, heading, _, *rows = [line for line in out.splitlines() if line]
    assert first == "no order found in 2 searches: blocked by right"
    assert heading.split() == ["tried", "after", "steps", "result"]
    assert [row.split()[:2] for row in rows[:2]] == [["left", "0"], ["right", "0"]]
    assert not list(Path().glob("off*"))
