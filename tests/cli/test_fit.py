"""Fit under the distance law: tools drawn inward, and the clearance that is told from contact."""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from bands import band_rows
from children import finished
from command_line import Run, command, poses, succeeded, tool
from hapticdb.kernels.field.packing import pack
from hapticdb.store.base import Band, Rows
from voxels import voxel_object

VOXEL = 0.001
FLOOR = 0.0325
"""Height of the floor, metres."""
ABOVE, BELOW = 0.0004, -0.0004
"""Where the underside of the tool is, from the floor, metres."""


@pytest.fixture
def floor(run: Run, tmp_path: Path) -> Path:
    """A floor that has distances, a cube of 2 cm, and poses of it above and below the floor."""
    del run  # has changed to the folder in which the environment is to be
    grid = hapticdb.Grid(VOXEL, (0.0, 0.0, 0.0), 6)
    low, high = 0.002, 0.062
    corners = np.array([[i, j, FLOOR] for i in (low, high) for j in (low, high)])
    made = band_rows(corners[[[0, 1, 2], [1, 2, 3]]], grid)
    rows = Rows(made.keys, np.zeros_like(made.keys), made.occupancy, Band(*pack(made.values)))
    with hapticdb.create(tmp_path / "floor.db", grid) as env:
        env.store.add(voxel_object(grid, made.voxels, "floor"), rows)
    tool(tmp_path / "tool.stl")
    places = [(0.032, 0.032, FLOOR + 0.01 + height) for height in (ABOVE, BELOW)]
    poses(tmp_path / "path.csv", *places)
    return tmp_path / "floor.db"


def touched(run: Run, floor: Path, *more: object) -> list[dict[str, object]]:
    args = ("touch", floor, "--tool", "tool.stl", "--poses", "path.csv", "--json", *more)
    out = succeeded(run(*args))
    return [json.loads(line) for line in out.splitlines()]


def lifts(frames: list[dict[str, object]]) -> list[float]:
    """Force of each frame along z, newtons."""
    return [frame["force"][2] for frame in frames]  # type: ignore[index]


def test_touch_distance_law_contact_at_surface(run: Run, floor: Path) -> None:
    frames = touched(run, floor)
    assert {frame["law"] for frame in frames} == {"distance"}
    above, below = lifts(frames)
    assert above == 0.0 < below
    inset, none = {"least": 1.5 * VOXEL, "greatest": 1.5 * VOXEL}, {"least": 0.0, "greatest": 0.0}
    assert [frame["shell"] for frame in frames] == 2 * [{"points": 300, "inset": inset}]
    frames = touched(run, floor, "--conservative")
    assert lifts(frames)[0] > 0.0
    assert frames[0]["shell"] == {"points": 300, "inset": none}
    frames = touched(run, floor, "--law", "plane")
    assert {frame["law"] for frame in frames} == {"plane"}
    assert frames[0]["shell"] == {"points": 300, "inset": none}
    args = ("touch", floor, "--tool", "tool.stl", "--poses", "path.csv")
    assert "drawn in by 1.5 mm" in run(*args)[1]
    assert "on the surface" in run(*args, "--conservative")[1]


def test_touch_inset_shell_late_contact_note(run: Run, floor: Path) -> None:
    hapticdb.PointShell.from_file("tool.stl", 100, inset=0.002).save("drawn.npz")
    args = ("touch", floor, "--tool", "drawn.npz", "--poses", "path.csv", "--json")
    for more, late in (((), "0.5 mm"), (("--conservative",), "2 mm"), (("--law", "plane"), "2 mm")):
        code, _, err = run(*args, *more)
        assert code == 0
        assert f"drawn in by 2 mm: contact begins up to {late} late" in err


def test_feel_tool_inset_unless_conservative(run: Run, floor: Path) -> None:
    args = ("feel", floor, "--tool", "tool.stl", "--device", "path.csv", "--seconds", 0.2)
    rest = ("--no-baseline", "--json")
    for more, inset in (((), 1.5 * VOXEL), (("--conservative",), 0.0), (("--law", "plane"), 0.0)):
        code, out, _ = run(*args, *rest, *more)
        assert code == 0
        assert json.loads(out)["shell"]["inset"] == {"least": inset, "greatest": inset}


def test_touch_cached_shell_same_forces_without_scipy(run: Run, floor: Path) -> None:
    cube = tool(floor.with_name("tool.stl"), is_open=True)
    comment = os.urandom(40).hex().encode()  # so that it is not kept yet
    cube.write_bytes(comment + cube.read_bytes()[80:])
    args = ("touch", floor, "--tool", "tool.stl", "--poses", "path.csv", "--json")
    _, first, notes = run(*args)
    assert "is open" in notes
    again = finished([sys.executable, "-X", "importtime", *command(*args)[1:]], check=True)
    assert "scipy.s" not in again.stderr
    told = [one for one in again.stderr.splitlines() if "hapticdb: " in one]
    assert told == notes.splitlines()
    pairs = zip(first.splitlines(), again.stdout.splitlines(), strict=True)
    for one, other in (map(json.loads, pair) for pair in pairs):
        assert one["force"] == other["force"]
        assert one["shell"] == other["shell"]
