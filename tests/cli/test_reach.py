"""The verb reach, with right and wrong arguments."""

import csv
import json
from pathlib import Path

import pytest

from command_line import Run, refused, succeeded

BESIDE = ("--tool", "tool.stl", "--axis", "0,1,0", "--step", "90deg", "--lift", "5cm")


def test_reach_row_per_target(run: Run, scene: Path) -> None:
    """Cubes of 100 mm, 200 mm apart; the tool is a cube of 20 mm about its origin."""
    words = ("reach", scene, "box0", "box2", *BESIDE)
    lines = succeeded(run(*words)).splitlines()
    assert lines[0] == "2 of 2 reachable"
    assert [line.split()[1:6] for line in lines[3:5]] == [
        ["box0", "reachable", "4", "of", "4"], ["box2", "reachable", "4", "of", "4"],
    ]  # fmt: skip
    first, second = map(json.loads, succeeded(run(*words, "--json")).splitlines())
    assert (first["name"], first["free"], first["gap"]) == ("box0", "all", 0.02)
    assert second["pose"][1] == pytest.approx([0, 0, 1, 0.05], abs=1e-9)
    code, out, _ = run(*words, "--csv", "-")
    rows = [*csv.DictReader(out.splitlines())]
    assert (code, [row["gap_m"] for row in rows]) == (0, ["0.02", "0.02"])


def test_reach_names_obstacle(run: Run, scene: Path) -> None:
    """Between two cubes there are 100 mm: less than the lift and the tool."""
    between = ("--tool", "tool.stl", "--axis", "1,0,0", "--lift", "95mm", "--turn", "1rad")
    code, out, err = run("reach", scene, "box0", "box2", *between)
    assert (code, err) == (1, "")
    assert out.startswith("1 of 2 reachable\n")
    first, second = out.splitlines()[3:5]
    assert first.split()[1:] == ["box0", "not", "reachable", "0", "of", "24", "-", "box1"]
    assert second.split()[1:3] == ["box2", "reachable"]
    assert run("reach", scene, "box0", *between, "--exclude", "box1")[0] == 0
    assert run("reach", scene, "box1", *between, "--seconds", "1e-9")[0] == 3


def test_reach_verb_bad_arguments(run: Run, scene: Path) -> None:
    words = ("reach", scene, "box0", "--tool", "tool.stl")
    refused(run(*words), "box0", "no single axis of symmetry", "--axis")
    refused(run("reach", scene, "nut", *words[3:]), "WORDS", "nut")
    refused(run(*words[:4], "tool.npz", "--axis", "0,0,1"), "no surface")
    refused(run(*words, "--axis", "up"), "--axis", "a direction")
    refused(run(*words, "--turn", "60mm"), "--turn", "give degrees")
    refused(run(*words, "--approach", "down"), "--approach")
