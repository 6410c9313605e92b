"""A URL's scheme picks the engine: one of this package, or one that another package adds."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import os
import sys
from pathlib import Path

import pytest
import trimesh

import hapticdb
from children import finished
from command_line import Run, boxes, poses, refused, run  # noqa: F401 - fixtures
from hapticdb.errors import UsageError
from installed import PAGE, install_toy

ROOT = Path(__file__).parent.parent.parent
CONTRACT, USE = [text for kind, text in PAGE if kind == "python"]


def test_a_scheme_that_no_engine_has_is_told() -> None:
    for url in ("memory://x", "http://host/x", "://x"):
        with pytest.raises(UsageError, match=r"give a path, sqlite:///path or postgresql://"):
            hapticdb.open(url)


def test_an_engine_whose_driver_is_missing_says_what_brings_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(hapticdb.errors.MissingExtraError, match=r"pip install .*'psycopg") as e:
        hapticdb.open("postgresql://me:secret@host/plant")
    assert "secret" not in str(e.value)


@pytest.mark.usefixtures("toy_is_installed")
def test_an_installed_engine_is_used_from_the_command_line(run: Run, tmp_path: Path) -> None:
    """The verbs import, objects, touch and check accept its URL."""
    boxes(tmp_path / "bracket.glb")
    trimesh.creation.icosphere(radius=0.02).export(tmp_path / "probe.stl")
    url = f"memory://{tmp_path.name}-line"
    code, _, err = run("import", url, "bracket.glb", "--voxel-size", "0.01")
    assert code == 0, err
    assert len(run("objects", url, "--json")[1].splitlines()) == 3
    where = poses(tmp_path / "path.csv", (0.0, 0.0, 0.055))
    code, out, err = run("touch", url, "--tool", "probe.stl", "--poses", where, "--json")
    assert code == 0, err
    assert out.count("force") >= 1
    assert run("check", url)[0] == 0
    assert run("copy", url, "copy.db")[0] == 0
    assert run("diff", url, "copy.db")[0] == 0
    refused(run("grant", url, "anna", "--as", "viewer"), "is on memory, which has no roles")
    refused(run("backup", url, "other.db"), "hapticdb copy")
    refused(run("backup", "copy.db", url), "is on memory, not a file")


def test_the_page_shows_the_contract_that_the_toy_passes() -> None:
    assert (ROOT / "tests" / "store" / "test_contract_memory.py").read_text() == CONTRACT


def test_what_the_page_says_runs(tmp_path: Path) -> None:
    """A fresh process finds the engine's entry point and runs the page's last block."""
    install_toy(tmp_path)
    boxes(tmp_path / "bracket.glb", count=1)
    trimesh.creation.icosphere(radius=0.06).export(tmp_path / "probe.stl")
    ways = os.pathsep.join([str(tmp_path), str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")])
    done = finished(
        [sys.executable, "-c", USE], cwd=tmp_path, env={**os.environ, "PYTHONPATH": ways}
    )
    assert done.returncode == 0, done.stderr
    assert "box0" in done.stdout
