"""Compiled kernels come from folders that nobody else can write into or replace."""

import os
import pwd
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from children import finished
from hapticdb.kernels import _cache
from hapticdb.kernels._cache import LENT

cache_folder = _cache.cache_folder.__wrapped__


@pytest.fixture(autouse=True)
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home with a user's cache, and a folder of temporary files."""
    (tmp_path / "temporary").mkdir()
    (tmp_path / "home").mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "home/cache"))
    monkeypatch.setenv(LENT, "")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return tmp_path


def lend(folder: Path) -> None:
    """Let the group write into a folder."""
    folder.chmod(0o770)


def give(folder: Path) -> None:
    """Give a folder to another user."""
    if os.geteuid():
        pytest.skip("root alone gives folders away")
    os.chown(folder, 4242, 4242)


@pytest.mark.parametrize("spoil", [lend, give])
@pytest.mark.parametrize("which", ["hapticdb", "cache", "home"])
def test_cache_folder_rejects_writable_by_others(
    folders: Path, which: str, spoil: Callable[[Path], None]
) -> None:
    first = cache_folder()
    assert first == folders / "home/cache/hapticdb"
    assert cache_folder() == first
    spoil({"hapticdb": first, "cache": first.parent, "home": folders / "home"}[which])
    with pytest.warns(RuntimeWarning, match=f"nothing is kept in {first}: .*{which} *"):
        second = cache_folder()
    assert second.parent == folders / "temporary"
    spoil(second)
    with pytest.warns(RuntimeWarning) as told:
        third = cache_folder()
    assert len(told) == 2
    assert third.parent == folders / "temporary"
    assert third.stat().st_mode & 0o777 == 0o700
    assert cache_folder() == third  # processes that this one starts use it, too


def test_cache_folder_resolves_symlink(folders: Path) -> None:
    """It is resolved once: who can replace the link gains nothing."""
    real = folders / "home/elsewhere"
    (real / "hapticdb").mkdir(parents=True)
    (folders / "home/cache").symlink_to(real)
    assert cache_folder() == real / "hapticdb"
    real.chmod(0o777)
    with pytest.warns(RuntimeWarning, match=f"others can write into {real}"):
        assert cache_folder().is_relative_to(folders / "temporary")


def test_cache_folder_accepts_sticky_folder(folders: Path) -> None:
    """As that of temporary files: nobody replaces there what is another's."""
    (folders / "home/cache").mkdir()
    (folders / "home/cache").chmod(0o1777)
    assert cache_folder() == folders / "home/cache/hapticdb"


def test_cache_folder_private_mode(folders: Path) -> None:
    (folders / "home/cache").mkdir()
    before = os.umask(0)
    try:
        made = cache_folder()
    finally:
        os.umask(before)
    assert made.stat().st_mode & 0o777 == 0o700


NOTED = """
import subprocess, sys
from hapticdb.cli.render import noting_warnings

with noting_warnings():
    from hapticdb.kernels._cache import cache_folder
    print(cache_folder(), flush=True)
if len(sys.argv) == 1:
    subprocess.run([sys.executable, __file__, "started"], check=True)
"""


def test_cache_folder_none_warns_and_cleans_up(folders: Path) -> None:
    cache_folder().chmod(0o777)
    (folders / f"temporary/hapticdb-{os.geteuid()}").touch()
    script = folders / "script.py"
    script.write_text(NOTED)
    env = os.environ | {"TMPDIR": str(folders / "temporary")}
    done = finished([sys.executable, str(script)], env=env, check=True)
    own, started = done.stdout.splitlines()
    assert own == started
    assert Path(own).parent == folders / "temporary"
    assert not Path(own).exists()
    said = f"hapticdb: nothing is kept in {folders}/home/cache/hapticdb: others can"
    assert done.stderr.startswith(said)
    assert done.stderr.count("\n") == 1


def test_cache_folder_without_home(folders: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", MagicMock(side_effect=KeyError))
    assert cache_folder() == folders / f"temporary/hapticdb-{os.geteuid()}"
