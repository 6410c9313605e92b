"""matplotlib is loaded by the verbs that draw a picture, and by no other verb."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import os
import sys
from pathlib import Path

import pytest

from children import finished
from command_line import command, made, run, scene  # noqa: F401 - fixtures
from hapticdb.cli import VERBS

STAND_IN = """
import os
open(os.environ["LOADED"], "w").close()
raise ImportError("nothing is to be drawn")
"""
"""Source of a stand-in for matplotlib: a process that imports it creates a file."""

TOOL = "--tool tool.npz"
LINES = {
    "import": "new.db file.obj --bits 5",
    "info": "scene.db",
    "objects": "scene.db",
    "touch": f"scene.db {TOOL} --poses path.csv",
    "feel": f"scene.db {TOOL} --device path.csv --seconds 0.2 --no-baseline --record s.hdbrec",
    "replay": "s.hdbrec scene.db",
    "sweep": f"scene.db {TOOL} --path path.csv",
    "extract": "scene.db 1 --motions 0 --out 0.1",
    "move": "scene.db 1 --translate 0,0,0",
    "remove": "scene.db 1",
    "copy": "scene.db copied.db",
    "diff": "scene.db scene.db",
    "check": "scene.db",
    "backup": "scene.db whole.db",
    "restore": "scene.db put.db",
    "upgrade": "scene.db",
    "grant": "scene.db anna --as viewer",
    "sample": "made --frames 2",
    "warm": "",
    "view": "scene.db --no-browser --seconds 1",
    "serve": "scene.db --seconds 1",
}
"""Arguments of each verb, without a picture."""
REFUSED = {"grant": 2}
"""Verbs with an exit code other than 0: an SQLite file has no roles."""
DRAWING = {"demo"}
"""Verbs that always draw."""
LONG = {"feel", "replay", "sweep", "extract", "sample", "warm", "view", "serve"}
TRIANGLE = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n"


@pytest.fixture
def variables(tmp_path: Path) -> dict[str, str]:
    """Environment variables of a process in which matplotlib is the stand-in."""
    package = tmp_path / "shadow" / "matplotlib"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(STAND_IN)
    folders = [str(package.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    paths = {"PYTHONPATH": os.pathsep.join(folders), "LOADED": str(tmp_path / "loaded")}
    return os.environ | paths


def test_every_verb_is_tried() -> None:
    assert set(LINES) | DRAWING == {verb.__name__.rstrip("_") for verb in VERBS}


@pytest.mark.parametrize(
    "verb", [pytest.param(v, marks=[pytest.mark.long] if v in LONG else []) for v in LINES]
)
def test_a_verb_without_a_picture_loads_no_matplotlib(
    variables: dict[str, str], scene: Path, tmp_path: Path, verb: str
) -> None:
    """The processes that the verb starts load none either."""
    (tmp_path / "file.obj").write_text(TRIANGLE)
    if verb == "replay":
        recorded = command("feel", *LINES["feel"].split())
        finished(recorded, cwd=scene.parent, env=variables, check=True)
    done = finished(command(verb, *LINES[verb].split()), cwd=scene.parent, env=variables)
    found = {"sweep": {1, 3}, "extract": {0, 3}}
    wanted = {**found, **{name: {code} for name, code in REFUSED.items()}}.get(verb, {0})
    assert done.returncode in wanted, done.stderr
    assert not (tmp_path / "loaded").exists()


@pytest.mark.parametrize("words", ["hapticdb", "hapticdb.cli, hapticdb.environment"])
def test_importing_the_package_loads_no_matplotlib(
    variables: dict[str, str], tmp_path: Path, words: str
) -> None:
    finished([sys.executable, "-c", f"import {words}"], env=variables, check=True)
    assert not (tmp_path / "loaded").exists()


@pytest.mark.long
def test_a_verb_with_a_picture_loads_it(
    variables: dict[str, str], scene: Path, tmp_path: Path
) -> None:
    """This shows that the stand-in does create its file."""
    line = f"{LINES['sweep']} --picture sweep.png"
    done = finished(command("sweep", *line.split()), cwd=scene.parent, env=variables)
    assert "nothing is to be drawn" in done.stderr
    assert (tmp_path / "loaded").exists()
