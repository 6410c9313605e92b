"""Damage in stored data raises an error where it is read; `hapticdb check` finds the rest."""

import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import apsw
import numpy as np
import pytest

import hapticdb
from command_line import Run
from crafted import CRAFTED, OF_BRICKS, edited, made
from hapticdb import Grid, PointShell
from hapticdb.store.base import Layout
from hapticdb.store.sqlite.raw import PAGE_BYTES
from voxels import KINDS, write_voxels

CASES = [
    *(("brick", name) for name in (CRAFTED | OF_BRICKS)),
    *(("voxel", name) for name, statements in CRAFTED.items() if "{layout}" in statements),
]


def told(ask: Callable[[], object]) -> str:
    """Text of the hapticdb error that a call raises, or "". Other errors are not caught."""
    try:
        ask()
    except hapticdb.errors.HapticDBError as error:
        return str(error)
    return ""


def used(path: Path, sphere: PointShell) -> None:
    """Run each of a user's calls by itself; a hapticdb error is allowed, another is not."""
    pose = np.eye(4)
    pose[:3, 3] = 0.06, 0.06, 0.21
    with hapticdb.open(path) as env:
        for ask in (
            env.objects,
            lambda: env.touch(sphere, pose, "array").objects,
            lambda: env.touch(sphere, pose, "statement", law="plane").objects,
            lambda: env.touch(sphere, pose, "cbgroup").objects,
            lambda: env.touch(sphere, pose).pairs,
            lambda: list(env.store.changes()),
            lambda: env.voxels(2),
            lambda: env.shell(2),
            lambda: env.move(2, np.eye(4)),
            lambda: env.store.costs("elsewhere"),
            lambda: env.quantiles(10),
            env.size,
            lambda: env.remove(2),
            env.analyze,
        ):
            said = told(ask)
            assert "\n" not in said
            assert len(said) < 500


@pytest.mark.parametrize(("layout", "name"), CASES)
def test_check_environment_finds_crafted_rows(
    tmp_path: Path, sphere: PointShell, layout: Layout, name: str
) -> None:
    path = made(tmp_path / "e.db", layout)
    edited(path, (CRAFTED | OF_BRICKS)[name], layout)
    report = hapticdb.check_environment(path)
    assert not report.is_sound
    assert all("\n" not in finding for finding in report.findings)
    assert "\n" not in told(lambda: used(path, sphere))


@pytest.mark.parametrize(("layout", "curve"), KINDS)
@pytest.mark.parametrize("bits", [1, 6])
def test_check_environment_sound_after_edits(
    tmp_path: Path, layout: Layout, curve: hapticdb.grid.CurveName, bits: int
) -> None:
    grid = Grid(0.01, (-0.1, 0.2, 0.0), bits, curve)
    rng = np.random.default_rng(bits)
    with hapticdb.create(tmp_path / "e.db", grid, layout=layout) as env:
        for seed in range(4):
            voxels = rng.integers(0, grid.side, (40, 3))
            write_voxels(env.store, np.unique(voxels, axis=0), f"{seed}")
        env.remove(2)
        env.analyze()
        report = hapticdb.check_environment(env.url)
        assert report.findings == []
        assert report.voxels == sum(obj.voxels for obj in env.objects())
        assert report.objects == 3


def test_check_exit_code(tmp_path: Path, run: Run) -> None:
    path = made(tmp_path / "sound.db", "brick")
    code, out, _ = run("check", path)
    assert (code, out.count("\n")) == (0, 1)
    assert "is sound: 2 objects" in out
    edited(path, CRAFTED["a wrong count"], "brick")
    code, out, _ = run("check", path)
    assert code == 1
    assert "object 2 (b) has" in out
    assert "1 finding" in out
    code, out, _ = run("check", path, "--json")
    assert code == 1
    assert json.loads(out)["is_sound"] is False
    (tmp_path / "text.db").write_text("x,y\n" * 100)
    assert run("check", tmp_path / "text.db")[0] == 2
    assert run("check", tmp_path / "none.db")[0] == 2


def test_resident_cells_damaged_page_one_line(tmp_path: Path) -> None:
    path = made(tmp_path / "e.db", "brick")
    with closing(apsw.Connection(str(path))) as connection:
        connection.execute("DELETE FROM cost")  # so that it measures, which reads
        root = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'brick'").get
    content = bytearray(path.read_bytes())
    content[(int(root) - 1) * PAGE_BYTES : int(root) * PAGE_BYTES] = bytes(PAGE_BYTES)
    path.write_bytes(content)
    with pytest.raises(hapticdb.errors.DamagedError, match="is damaged") as caught:
        hapticdb.ResidentCells(str(path))
    assert "\n" not in str(caught.value)
