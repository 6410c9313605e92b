"""The toy engine as if `pip install` had installed its distribution, for one test."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from hapticdb.store import engines

BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PAGE = BLOCK.findall((Path(__file__).parent.parent / "docs" / "extending.md").read_text())
"""Kind and text of each block of the page that says how an engine is added."""
(ENTRY_POINT,) = [text for kind, text in PAGE if kind == "toml"]


def install_toy(folder: Path) -> None:
    """Make a folder of modules in which the toy's distribution has the entry point of the page."""
    group, line = ENTRY_POINT.splitlines()
    name = re.fullmatch(r'\[project\.entry-points\."(.+)"\]', group)
    assert name
    installed = folder / "toy_engine-1.0.dist-info"
    installed.mkdir(parents=True)
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-engine\nVersion: 1.0\n")
    (installed / "entry_points.txt").write_text(f"[{name[1]}]\n{line.replace(chr(34), '')}\n")


@pytest.fixture
def toy_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    install_toy(tmp_path / "installed")
    monkeypatch.syspath_prepend(str(tmp_path / "installed"))
    engines._installed.cache_clear()
    yield
    engines._installed.cache_clear()
