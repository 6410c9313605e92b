"""The verb sweep with a machine, with right and wrong arguments."""

import csv
import json
from pathlib import Path

import pytest

from command_line import Run, refused, succeeded

HOOK = '<link name="hook"><collision><geometry>{}</geometry></collision></link>'
SLIDE = """
<robot name="slide"><link name="rail"/>{}
  <joint name="x" type="prismatic"><parent link="rail"/><child link="hook"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="0.5"/></joint></robot>
"""
WORDS = ("--machine", "slide.urdf", "--joints", "path.csv")


@pytest.fixture
def sweep(scene: Path) -> tuple[object, ...]:
    """A cube of 20 mm on a rail along x, from -0.3 m to 0.6 m; the first box begins at -0.05 m."""
    cube = HOOK.format('<box size="0.02 0.02 0.02"/>')
    (scene.parent / "slide.urdf").write_text(SLIDE.format(cube))
    (scene.parent / "path.csv").write_text("x [mm]\n-300\n600\n")
    return ("sweep", scene, *WORDS)


def test_sweep_machine_clear_has_its_gap(run: Run, sweep: tuple[object, ...]) -> None:
    place = ("--at", "0,0,100,1,0,0,0")
    code, out, err = run(*sweep, *place)
    assert (code, err) == (
        0, "hapticdb: joint x is at 0.6 m in row 1, above 0.5, its limit\n"
    )  # fmt: skip
    assert out.startswith("clear by 40 mm: nearest hook and box")
    found = json.loads(run(*sweep, *place, "--json")[1])
    assert (found["verdict"], found["moved"], found["path"]) == ("clear", "slide.urdf", "path.csv")
    assert found["gap"] <= 0.04 <= found["gap_at_most"]
    assert found["nearest"]["body"] == "hook"


def test_sweep_machine_hits_have_link_and_place(run: Run, sweep: tuple[object, ...]) -> None:
    code, out, _ = run(*sweep)
    assert (code, out.splitlines()[0]) == (
        1, "hook hits box0 at 26.7 % of the path; then hook and box1, hook and box2"
    )  # fmt: skip
    code, out, _ = run(*sweep, "--csv", "-")
    rows = list(csv.DictReader(out.splitlines()))
    assert code == 1
    assert [(row["body"], row["name"]) for row in rows] == [("hook", f"box{n}") for n in range(3)]
    assert float(rows[0]["fraction"]) == pytest.approx(0.24 / 0.9, abs=1e-4)


def test_sweep_machine_exit_codes(run: Run, sweep: tuple[object, ...], scene: Path) -> None:
    code, out, _ = run(*sweep, "--seconds", 1e-9)
    assert (code, out.partition(":")[0]) == (3, "not decided")
    (scene.parent / "path.csv").write_text("x\n0\n")
    code, out, _ = run(*sweep, "--at", "0,0,59,1,0,0,0", "--where", "box0")
    assert (code, "for overlaps at the start: hook and box0 1" in out) == (4, True)
    succeeded(run(*sweep, "--at", "0,0,60,1,0,0,0", "--where", "box0"))


@pytest.mark.parametrize(
    ("file", "text", "told"),
    [
        ("path.csv", "x,y\n0,0\n", "path.csv: joint 'y' is none of its: x"),
        ("path.csv", "x [deg]\n0\n", "'x [deg]': give x in"),
        ("path.csv", "x\nhere\n", "path.csv, row 0: 'here' is no number"),
        ("slide.urdf", SLIDE.format(HOOK.format('<mesh filename="none.stl"/>')),
         "slide.urdf: link 'hook': its mesh 'none.stl' is not beside the file"),
        ("slide.urdf", "solid", "slide.urdf is no XML"),
    ],
)  # fmt: skip
def test_sweep_machine_refuses_a_bad_file_in_one_line(
    run: Run, sweep: tuple[object, ...], scene: Path, file: str, text: str, told: str
) -> None:
    (scene.parent / file).write_text(text)
    refused(run(*sweep), told)


@pytest.mark.usefixtures("sweep")
def test_sweep_machine_refuses_contradictory_options(run: Run, scene: Path) -> None:
    refused(run("sweep", scene, *WORDS[:2]), "--machine", "--joints")
    refused(run("sweep", scene, *WORDS[2:]), "--machine", "--joints")
    refused(run("sweep", scene, "--machine", "none.urdf", *WORDS[2:]), "cannot read none.urdf")
    refused(run("sweep", scene, *WORDS, "--srdf", "none.srdf"), "cannot read none.srdf")
    refused(run("sweep", scene, *WORDS, "--tool", "tool.stl"), "--machine and --tool")
    refused(run("sweep", scene, *WORDS, "--at", "0,0"), "--at", "x,y,z,qw,qx,qy,qz")
    refused(run("sweep", scene, *WORDS, "--about", "0,0,0"), "--about")
    refused(run("sweep", scene, *WORDS, "--contact", 0), "contact 0.0 m: give a length above 0")
