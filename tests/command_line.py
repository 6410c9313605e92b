"""The command line as tests use it: run in an empty folder, on a small environment."""

import contextlib
import os
import pty
import shutil
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import pytest
import trimesh

import hapticdb
from children import joined
from hapticdb.cli import main
from hapticdb.paper.cost_model import CostModel, machine_name

PLACES = ((0.0, 0.0, 0.0635), (0.0, 0.0, 0.3), (0.2, 0.0, -0.0635))
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Runs a command line in an empty folder: exit code, standard output, standard error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")

    def call(*args: object) -> tuple[int, str, str]:
        capfd.readouterr()
        code = main([str(arg) for arg in args])
        out, err = capfd.readouterr()
        return code, out, err

    return call


def command(*args: object) -> list[str]:
    """Arguments that run that command line in a process of its own."""
    return [sys.executable, "-m", "hapticdb", *map(str, args)]


def on_terminal(*args: object, out: TextIO | None = None, code: int = 0) -> str:
    """What a terminal shows of a command; `out` : where standard output goes instead."""
    ours, theirs = pty.openpty()
    seen = bytearray()

    def read() -> None:
        with contextlib.suppress(OSError):  # the other side is closed
            while chunk := os.read(ours, 4096):
                seen.extend(chunk)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    with (
        os.fdopen(theirs, "w") as screen,
        contextlib.redirect_stdout(out or screen),
        contextlib.redirect_stderr(screen),
    ):
        ended = main([str(arg) for arg in args])
    joined(reader)
    os.close(ours)
    assert ended == code
    return seen.decode()


def refused(result: tuple[int, str, str], *words: str) -> str:
    """Check that a command was refused with exit code 2 and one line, which is returned."""
    code, _, err = result
    assert code == 2, result
    lines = err.splitlines()
    assert len(lines) == 1, err
    assert lines[0].startswith("hapticdb: ")
    for word in words:
        assert word in lines[0]
    return lines[0]


def succeeded(result: tuple[int, str, str]) -> str:
    """Check that a command ended well and complained of nothing; returns its standard output."""
    code, out, err = result
    assert (code, err) == (0, ""), result
    return out


def boxes(path: Path, count: int = 3, side: float = 0.1, subdivisions: int = 0) -> Path:
    """A file of boxes in a row along x, 0.2 m apart."""
    scene = trimesh.Scene()
    for n in range(count):
        box = trimesh.creation.box((side, side, side))
        for _ in range(subdivisions):
            box = box.subdivide()
        placed = trimesh.transformations.translation_matrix((0.2 * n, 0, 0))
        scene.add_geometry(box, node_name=f"box{n}", geom_name=f"box{n}", transform=placed)
    path.write_bytes(scene.export(file_type="glb"))
    return path


def tool(path: Path, *, is_open: bool = False) -> Path:
    """A cube of 2 cm; an open one lacks a side."""
    cube = trimesh.creation.box((0.02, 0.02, 0.02))
    if is_open:
        cube.update_faces(np.arange(len(cube.faces)) > 1)
    path.write_bytes(cube.export(file_type="stl"))
    return path


def poses(path: Path, *places: tuple[float, float, float]) -> Path:
    lines = ["x,y,z,qw,qx,qy,qz", *(f"{x},{y},{z},1,0,0,0" for x, y, z in places)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an environment of three boxes, a tool, and poses that touch two of them."""
    folder = tmp_path_factory.mktemp("made")
    file = boxes(folder / "boxes.glb")
    assert main(["import", str(folder / "scene.db"), str(file), "--bits", "6"]) == 0
    with hapticdb.open(folder / "scene.db") as env:  # so that no verb measures
        env.store.save_costs(machine_name(), CostModel.of_equal_parts().figures())
    hapticdb.PointShell.from_file(tool(folder / "tool.stl")).save(folder / "tool.npz")
    poses(folder / "path.csv", *PLACES)
    return folder


@pytest.fixture
def scene(run: Run, made: Path, tmp_path: Path) -> Path:
    """A copy of the environment, tool and path of `made`; the file of boxes stays in its folder."""
    del run  # has changed to the folder in which the environment is to be
    for name in ("scene.db", "tool.stl", "tool.npz", "path.csv"):
        shutil.copy(made / name, tmp_path)
    return tmp_path / "scene.db"


def rows_of(url: Path | str) -> list[tuple[Any, ...]]:
    """Every row of the table of objects and of the index table, in either layout."""
    with hapticdb.open(url, read_only=True) as env:
        found = [(obj.id, obj.name, obj.digest, obj.voxels) for obj in env.objects()]
        keys, ids, bits, _ = env.store.scan(np.zeros(1, np.int64), np.array([2**62]))
    return [*found, *zip(keys.tolist(), ids.tolist(), strict=True), (bits.tobytes(),)]
