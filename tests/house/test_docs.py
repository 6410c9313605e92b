"""Every block of the pages runs, and the SQL in the docs is the SQL that runs."""

import os
import re
import sys
import tempfile
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from children import finished
from hapticdb.cli.options import TEXTS
from hapticdb.mesh.parse import READERS
from hapticdb.store.postgres.connecting import link
from hapticdb.store.postgres.tables import statements
from hapticdb.store.sqlite.tables import force as sqlite_force
from hapticdb.store.sqlite.tables import ranges as sqlite_ranges
from hapticdb.verdicts import EXTRACT_VERDICTS, REPORTED, SWEEP_VERDICTS
from postgres_servers import Binaries, serving
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
@pytest.mark.parametrize(
    "pages",
    [
        ("README.md", "docs/query.md"),
        ("docs/realtime.md",),
        ("docs/paths.md",),
        ("docs/clashes.md",),
        ("docs/machines.md",),
    ],
)
def test_docs_blocks_run(tmp_path: Path, pages: tuple[str, ...]) -> None:
    """All shell blocks in one session of the shell, then all Python blocks in one of Python."""
    tools = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    script = "\n".join(block for page in pages for block in blocks("sh", page))
    bash = ["bash", "-euo", "pipefail", "-c", script]
    done = finished(bash, cwd=tmp_path, env=os.environ | {"PATH": tools}, timeout=LONG)
    assert done.returncode == 0, done.stderr
    session = "\n".join(block for page in pages for block in blocks("python", page))
    done = finished([sys.executable, "-c", session], cwd=tmp_path, timeout=LONG)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
@pytest.mark.parametrize("binaries", FOUND, ids=named)
def test_docs_postgresql_blocks_run(tmp_path: Path, binaries: Binaries) -> None:
    """The blocks use a server that libpq's environment variables name, and its pg_dump."""
    tools = f"{Path(sys.executable).parent}{os.pathsep}{binaries.bindir}{os.pathsep}"
    with serving(Path(tempfile.mkdtemp(prefix="plant-")), binaries, SETTINGS) as server:
        options = parse_qs(urlsplit(server.conninfo()).query)
        variables = {
            "PATH": tools + os.environ["PATH"],
            **{f"PG{name.upper()}": value for name, (value,) in options.items()},
        }
        found = ""
        for block in ["createdb plant", *blocks("sh", "docs/postgresql.md")]:
            bash = ["bash", "-euo", "pipefail", "-c", block]
            done = finished(bash, cwd=tmp_path, env=os.environ | variables, timeout=LONG)
            assert done.returncode == 0, done.stderr
            found = done.stdout
    assert "postgresql:///plant and postgresql:///restored hold the same" in found


def test_docs_postgresql_settings() -> None:
    page = (ROOT / "docs" / "postgresql.md").read_text()
    shown = re.findall(r"^\| `(\w+)` \| `(\w+)` \|", page, re.MULTILINE)
    assert dict(shown) == link.SETTINGS


def test_docs_sql_equals_code() -> None:
    shown = SHOWN.findall((ROOT / "docs" / "query.md").read_text())
    assert len(shown) == 8
    for module, constant, layout, text in shown:
        runs = getattr(CODE[module], constant)[layout]
        assert text.split() == runs.split()


def test_docs_verdicts_and_kinds() -> None:
    paths, clashes = ((ROOT / "docs" / f"{name}.md").read_text() for name in ("paths", "clashes"))
    rows = re.findall(r"^\| \*?([a-z ]+?)\*? \| (\d) \|", paths, re.MULTILINE)
    shown = {(one, str(one.exit_status)) for one in (*SWEEP_VERDICTS, *EXTRACT_VERDICTS)}
    assert set(rows) == shown
    assert {*re.findall(r"^\| \*([a-z ]+)\* \|", clashes, re.MULTILINE)} >= {*REPORTED}


def test_docs_formats() -> None:
    """The README and the help of import name each format."""
    readme = re.search(
        r"^hapticdb import .*# or .*", (ROOT / "README.md").read_text(), re.MULTILINE
    )
    texts = readme[0] if readme else "", next(t for t in TEXTS.splitlines() if "import.files" in t)
    for reader in {*READERS.values()}:
        names = [suffix[1:] for suffix in READERS if READERS[suffix] == reader]
        named = [re.search(rf"\b({'|'.join(names)})\b", one, re.IGNORECASE) for one in texts]
        assert len(named) == 2, texts
        assert all(named), names


def test_docs_links_resolve() -> None:
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")):
        for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
            assert "://" in target or (path.parent / target).exists(), f"{path}: {target}"
