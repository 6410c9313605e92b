"""`hapticdb touch --law`: what the words choose, and what they refuse."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hapticdb
from command_line import Run, run  # noqa: F401 - fixtures
from hapticdb import PointShell
from hapticdb.testing import floor_voxels, write_voxels
from smooth_scenes import TOP, VOXEL, imported


@pytest.fixture
def scene(tmp_path: Path) -> str:
    """An environment with distances, a ball that comes down on it, and three poses."""
    imported(tmp_path / "smooth.db").close()
    PointShell.sphere(0.03, 200).save(tmp_path / "tool.npz")
    lines = ["x,y,z,qw,qx,qy,qz"]
    lines += [f"-0.05,0,{TOP + 0.03 + u * VOXEL:.6f},1,0,0,0" for u in (1.2, 0.8, 9.0)]
    (tmp_path / "path.csv").write_text("\n".join(lines) + "\n")
    return "smooth.db"


def touched(run: Run, url: str, *more: object) -> list[dict[str, Any]]:
    code, out, _ = run("touch", url, "--tool", "tool.npz", "--poses", "path.csv", "--json", *more)
    assert code == 0
    return [json.loads(line) for line in out.splitlines()]


def test_the_law_is_smooth_where_distances_are_unless_it_is_named(run: Run, scene: str) -> None:
    smooth, plane = touched(run, scene), touched(run, scene, "--law", "plane")
    assert [frame["law"] for frame in smooth] == ["smooth"] * 3
    assert [frame["law"] for frame in plane] == ["plane"] * 3
    named = touched(run, scene, "--law", "smooth", "--stiffness", 500)
    pose = np.eye(4)
    shell = PointShell.sphere(0.03, 200)
    with hapticdb.open(scene, read_only=True) as env:
        for frame, half, flat, u in zip(smooth, named, plane, (1.2, 0.8, 9.0), strict=True):
            pose[:3, 3] = [-0.05, 0.0, float(f"{TOP + 0.03 + u * VOXEL:.6f}")]
            felt = env.touch(shell, pose)
            assert frame["force"] == felt.force.tolist()
            assert frame["contacts"] == len(felt.contacts)
            assert [obj["id"] for obj in frame["objects"]] == [obj.id for obj in felt.objects]
            np.testing.assert_allclose(half["force"], felt.force / 2)
            assert flat["force"] == [0.0, 0.0, 0.0]
    assert smooth[1]["contacts"]
    assert smooth[1]["force"][2] > smooth[0]["force"][2] > 0.0
    assert smooth[2]["force"] == [0.0, 0.0, 0.0]


@pytest.mark.usefixtures("scene")
def test_without_distances_the_law_is_the_plane_and_smooth_is_refused(
    run: Run, tmp_path: Path
) -> None:
    with hapticdb.create(tmp_path / "flat.db", hapticdb.Grid(VOXEL, (-0.16,) * 3, 6)) as env:
        write_voxels(env.store, floor_voxels(env.grid), "floor")
    assert {frame["law"] for frame in touched(run, "flat.db")} == {"plane"}
    args = ("touch", "flat.db", "--tool", "tool.npz", "--poses", "path.csv", "--law")
    code, out, err = run(*args, "smooth")
    assert (code, out) == (2, "")
    assert "1 of 1 objects" in err
    code, out, err = run(*args, "soft")
    assert (code, out) == (2, "")
    assert "soft" in err


def test_the_statement_refuses_the_smooth_law(run: Run, scene: str) -> None:
    code, _, err = run(
        "touch", scene, "--tool", "tool.npz", "--poses", "path.csv", "--strategy", "statement"
    )
    assert code == 2
    assert "tangent-plane law alone" in err
