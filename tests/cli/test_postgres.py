"""The command line on PostgreSQL: the same as on a file, and a server's own failures."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import re
import shutil
import signal
from contextlib import AbstractContextManager
from pathlib import Path
from subprocess import Popen

import psycopg
import pytest
from psycopg import sql

from children import PATIENCE, child, finished
from cli.test_verbs import (  # noqa: F401 - the same lines again, on the fixture `scene` below
    test_calibrate_prints_figures_with_their_spread,
    test_info_json_has_the_documented_keys,
    test_info_speaks_to_people,
    test_statistics_are_renewed_after_many_edits,
)
from command_line import PLACES, Run, boxes, command, made, poses, refused, rows_of, run, tool  # noqa: F401 - fixtures
from hapticdb.demo import prepare
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.store.urls import redact
from servers import Place


@pytest.fixture
def scene(run: Run, made: Path, tmp_path: Path, place: Place) -> str:
    """The environment of three boxes on a server, with tool and path in the folder.

    The environment is copied, since an import would start a process to read the file.
    """
    for name in ("tool.stl", "tool.npz", "path.csv"):
        shutil.copy(made / name, tmp_path)
    url = place()
    assert run("copy", made / "scene.db", url)[0] == 0
    return url


# -- import ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ["brick", "voxel"])
def test_an_import_holds_the_rows_of_one_into_a_file(
    run: Run, made: Path, place: Place, layout: str
) -> None:
    url, file = place(), made / "boxes.glb"
    options = (file, "--bits", 6, "--layout", layout)
    code, out, err = run("import", url, *options)
    assert (code, err) == (0, "")
    assert "3 objects imported" in out
    assert f"{redact(url)}: 3 objects" in out
    assert run("import", "file.db", *options)[0] == 0
    assert rows_of(url) == rows_of("file.db")
    before = rows_of(url)
    code, out, err = run("import", url, *options)
    assert (code, err) == (0, "")
    assert "complete already (3 objects), nothing to do" in out
    assert rows_of(url) == before


# -- failures that only a server has --------------------------------------------------------------


def test_no_server_is_one_line(run: Run, tmp_path: Path) -> None:
    refused(run("info", f"postgresql:///x?host={tmp_path}"), "cannot be reached")
    refused(run("info", "postgresql://127.0.0.1:1/x"), "cannot be reached", "refused")
    unescaped = "postgresql://me:h@nter@localhost:1/x"
    assert "nter" not in refused(run("info", unescaped), "%40")


def test_a_missing_database_is_one_line(run: Run, database: str, made: Path) -> None:
    url = re.sub(r"(://[^/]*)/[^?]*", r"\1/nowhere", parse(database).conninfo)
    refused(run("info", url), '"nowhere" does not exist', "createdb")
    refused(run("import", url, made / "boxes.glb"), '"nowhere" does not exist', "createdb")


# -- a private server -----------------------------------------------------------------------------

PRIVATE = "postgresql:///local?data=server"


def started(tmp_path: Path, *args: object) -> AbstractContextManager["Popen[str]"]:
    """The command line in its own process, which releases a private server when it ends."""
    return child(command(*args), cwd=tmp_path)


@pytest.mark.long
def test_a_private_server_comes_and_goes_with_the_commands(made: Path, tmp_path: Path) -> None:
    importing = command("import", PRIVATE, made / "boxes.glb", "--bits", 6)
    done = finished(importing, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"{PRIVATE}: 3 objects" in done.stdout
    folder = tmp_path / "server"
    assert folder.is_dir()
    args = ("touch", PRIVATE, "--tool", made / "tool.npz", "--poses", made / "path.csv", "--json")
    with started(tmp_path, *args) as one, started(tmp_path, *args) as other:
        ended = [process.communicate(timeout=PATIENCE) for process in (one, other)]
    assert [one.returncode, other.returncode] == [0, 0], ended
    assert {out.count('"pose"') for out, _ in ended} == {len(PLACES)}
    assert not PrivateServer.at(folder).is_running


@pytest.mark.long
def test_a_private_server_goes_with_a_command_that_the_system_ends(
    made: Path, tmp_path: Path
) -> None:
    importing = command("import", PRIVATE, made / "boxes.glb", "--bits", 6)
    finished(importing, cwd=tmp_path, check=True)
    stl = tool(tmp_path / "tool.stl")
    many = poses(tmp_path / "many.csv", *[(0.0, 0.0, 0.055)] * 20_000)
    args = ("touch", PRIVATE, "--tool", stl, "--poses", many, "--json")
    with started(tmp_path, *args) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        assert PrivateServer.at(tmp_path / "server").is_running
        process.terminate()
        _, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, err) == (128 + signal.SIGTERM, "")
    assert not PrivateServer.at(tmp_path / "server").is_running


def test_reading_sets_no_server_up(run: Run, tmp_path: Path) -> None:
    for verb, *rest in (("info",), ("move", "1", "--translate", "0,0,1")):
        refused(run(verb, PRIVATE, *rest), "no environment", "hapticdb import URL FILE")
    (tmp_path / "empty.obj").write_bytes(b"")
    refused(run("import", PRIVATE, "empty.obj"), "empty.obj")
    assert not (tmp_path / "server").exists()


def test_a_private_server_has_no_host(run: Run, tmp_path: Path) -> None:
    refused(run("info", "postgresql://host/x?data=server"), "leave host")
    refused(run("info", "postgresql:///x?data=server&user=me"), "leave host")
    refused(run("info", "postgresql:///x?data="), "names no folder")
    (tmp_path / "server").mkdir()
    (tmp_path / "server" / "mine").touch()
    refused(run("info", PRIVATE), "holds something else")


# -- the demo -------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_demo_stands_beside_an_environment_and_joins_its_own(
    run: Run, scene: str, admin: psycopg.Connection, tmp_path: Path
) -> None:
    before = rows_of(scene)
    args = ("demo", "demo", "--url", scene, "--frames", 12, "--points", 40, "--bits", 7)
    name = parse(scene).environment
    try:
        code, out, _ = run(*args)
        assert code == 0
        assert "there already" not in out
        assert "all agreed: hits, ids and wrench bit for bit" in out
        for layout in ("brick", "voxel"):
            assert re.search(rf"^PostgreSQL [\d.]+, {layout} layout, ", out, re.MULTILINE)
        assert f"environment={name}_demo_car:" in out
        again = prepare("demo", url=scene, bits=7, frames=12, points=40)
        assert [one.is_new for one in again.imported] == [False, False]
        assert (tmp_path / "demo" / "demo.png").is_file()
        assert rows_of(scene) == before
        code, out, err = run(*args[:-1], 6)
        assert (code, out) == (2, "")
        assert "is of another demo" in err
    finally:
        for layout in ("", "_voxel"):
            schema = sql.Identifier(f"{name}_demo_car{layout}")
            admin.execute(sql.SQL("DROP SCHEMA IF EXISTS {} CASCADE").format(schema))
