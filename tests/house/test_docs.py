"""Every block of the README runs, and the SQL in the docs is the SQL that runs."""

import os
import re
import sys
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from children import finished
from hapticdb.cli import app
from hapticdb.store.postgres.connecting import link
from hapticdb.store.postgres.private_server import Binaries, PrivateServer
from hapticdb.store.postgres.tables import statements
from hapticdb.store.sqlite.tables import force as sqlite_force
from hapticdb.store.sqlite.tables import ranges as sqlite_ranges
from servers import FOUND, SETTINGS, named

ROOT = Path(__file__).parent.parent.parent
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHOWN = re.compile(r"<!-- sql: (\w+)\.(\w+)\[\"(\w+)\"\] -->\n```sql\n(.*?)```", re.DOTALL)
LONG = 600.0
"""Longest time in seconds for one block of a page."""
CODE = {"sqlite_ranges": sqlite_ranges, "sqlite_force": sqlite_force, "statements": statements}


def blocks(kind: str, page: str = "README.md") -> list[str]:
    return [text for name, text in BLOCK.findall((ROOT / page).read_text()) if name == kind]


@pytest.mark.long
def test_every_block_of_the_readme_runs(tmp_path: Path) -> None:
    """Shell blocks run first, since Python needs the sample; then all Python in one session."""
    tools = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for block in blocks("sh"):
        bash = ["bash", "-euo", "pipefail", "-c", block]
        done = finished(bash, cwd=tmp_path, env=os.environ | {"PATH": tools}, patience=LONG)
        assert done.returncode == 0, done.stderr
    (tmp_path / "car.db").unlink()
    session = "\n".join(blocks("python"))
    done = finished([sys.executable, "-c", session], cwd=tmp_path, patience=LONG)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) >= 100


@pytest.mark.long
def test_every_block_of_the_realtime_page_runs(tmp_path: Path) -> None:
    """Shell blocks run first; the Python blocks use the files that the shell has made."""
    page = "docs/realtime.md"
    tools = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for block in blocks("sh", page):
        for line in block.splitlines():
            bash = ["bash", "-euo", "pipefail", "-c", line]
            done = finished(bash, cwd=tmp_path, env=os.environ | {"PATH": tools}, patience=LONG)
            # exit code 1 of a sweep: the part hits something
            assert done.returncode == (1 if " sweep " in line else 0), done.stderr
    session = "\n".join(blocks("python", page))
    done = finished([sys.executable, "-c", session], cwd=tmp_path, patience=LONG)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "sweep.png").stat().st_size > 10_000


@pytest.mark.long
def test_every_block_of_the_page_of_paths_runs(tmp_path: Path) -> None:
    """In one session of the shell: each line needs what those before it have made."""
    tools = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    bash = ["bash", "-euo", "pipefail", "-c", "\n".join(blocks("sh", "docs/paths.md"))]
    done = finished(bash, cwd=tmp_path, env=os.environ | {"PATH": tools}, patience=LONG)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "hood.png").stat().st_size > 10_000
    assert (tmp_path / "hood.csv").read_text().startswith("object_id,")


@pytest.mark.long
def test_every_block_of_the_page_of_batches_runs(tmp_path: Path) -> None:
    """The shell makes the sample; then all Python blocks run in one session."""
    page = "docs/batches.md"
    tools = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for block in blocks("sh", page):
        bash = ["bash", "-euo", "pipefail", "-c", block]
        done = finished(bash, cwd=tmp_path, env=os.environ | {"PATH": tools}, patience=LONG)
        assert done.returncode == 0, done.stderr
    session = "\n".join(blocks("python", page))
    done = finished([sys.executable, "-c", session], cwd=tmp_path, patience=LONG)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_every_block_of_the_page_of_the_way_out_runs(tmp_path: Path) -> None:
    tools = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for block in blocks("sh", "docs/extract.md"):
        bash = ["bash", "-euo", "pipefail", "-c", block]
        done = finished(bash, cwd=tmp_path, env=os.environ | {"PATH": tools}, patience=LONG)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "out.csv").exists()


@pytest.mark.long
@pytest.mark.parametrize("binaries", [b for b in FOUND if not isinstance(b, str)], ids=named)
def test_every_block_of_the_postgresql_page_runs(tmp_path: Path, binaries: Binaries) -> None:
    """The blocks use a private server, named by libpq's environment variables, and its pg_dump."""
    server = PrivateServer.at(tmp_path / "plant", binaries, SETTINGS)
    server.start()
    server.create_database("plant")
    options = parse_qs(urlsplit(server.conninfo("plant")).query)
    tools = f"{Path(sys.executable).parent}{os.pathsep}{binaries.bindir}{os.pathsep}"
    variables = {
        "PATH": tools + os.environ["PATH"],
        **{f"PG{name.upper()}": value for name, (value,) in options.items()},
    }
    try:
        found = ""
        for block in blocks("sh", "docs/postgresql.md"):
            bash = ["bash", "-euo", "pipefail", "-c", block]
            done = finished(bash, cwd=tmp_path, env=os.environ | variables, patience=LONG)
            assert done.returncode == 0, done.stderr
            found = done.stdout
    finally:
        server.stop()
    assert "postgresql:///plant and postgresql:///restored hold the same" in found


def test_the_postgresql_page_gives_the_settings_that_are_set() -> None:
    page = (ROOT / "docs" / "postgresql.md").read_text()
    shown = re.findall(r"^\| `(\w+)` \| `(\w+)` \|", page, re.MULTILINE)
    assert dict(shown) == link.SETTINGS


def test_every_make_line_of_the_readme_is_run_by_ci() -> None:
    ci = (ROOT / ".ci" / "run").read_text()
    named = re.findall(r"^    (make \w+)", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert named == ["make demo", "make test"]
    for line in named:
        assert line in ci


def test_the_docs_show_the_sql_that_runs() -> None:
    shown = SHOWN.findall((ROOT / "docs" / "strategies.md").read_text())
    assert len(shown) == 9
    for module, constant, layout, text in shown:
        runs = getattr(CODE[module], constant)[layout]
        assert text.split() == runs.split()


@pytest.mark.parametrize(
    "page",
    [
        "README.md",
        "ARCHITECTURE.md",
        "CONTRIBUTING.md",
        *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))),
    ],
)
def test_every_link_in_the_docs_leads_somewhere(page: str) -> None:
    path = ROOT / page
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
        if "://" not in target:
            assert (path.parent / target).exists(), target


def test_the_readme_names_every_command() -> None:
    readme = (ROOT / "README.md").read_text()
    for command in app.registered_commands:
        assert command.callback is not None
        verb = (command.name or command.callback.__name__).replace("_", "-")
        assert f"hapticdb {verb}" in readme or f"make {verb}" in readme, verb
