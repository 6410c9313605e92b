"""Compiled kernels come from folders that nobody else can write into."""

import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numba
import pytest
from numba import types
from numba.core.caching import FunctionCache

from children import finished
from hapticdb.kernels._cache import LENT, cache_folder
from hapticdb.kernels._jit import _Cache


@pytest.fixture(autouse=True)
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user's cache and a folder of temporary files."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
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


def link(folder: Path) -> None:
    """Put a link in a folder's place."""
    folder.rename(folder.with_suffix(".moved"))
    folder.symlink_to(folder.with_suffix(".moved"))


def open_around(folder: Path) -> None:
    """Let all replace a folder."""
    folder.parent.chmod(0o777)


@pytest.mark.parametrize("spoil", [lend, give, link, open_around])
@pytest.mark.parametrize("which", ["kernels", "outer"])
def test_a_folder_that_others_could_write_into_is_not_used(
    folders: Path, which: str, spoil: Callable[[Path], None]
) -> None:
    first = Path(cache_folder())
    assert first.is_relative_to(folders / "cache")
    assert cache_folder() == str(first)
    spoil(first if which == "kernels" else first.parent)
    with pytest.warns(RuntimeWarning, match=f"not kept in {first}: it is a link"):
        second = Path(cache_folder())
    assert second.is_relative_to(folders / "temporary")
    spoil(second if which == "kernels" else second.parent)
    with pytest.warns(RuntimeWarning) as told:
        third = Path(cache_folder())
    assert len(told) == 2
    assert third.parent == folders / "temporary"
    assert third.stat().st_mode & 0o777 == 0o700
    assert cache_folder() == str(third)  # processes that this one starts use it, too


def test_folders_are_made_for_the_user_alone(folders: Path) -> None:
    (folders / "cache").mkdir()
    before = os.umask(0)
    try:
        made = Path(cache_folder())
    finally:
        os.umask(before)
    assert {path.stat().st_mode & 0o777 for path in (made, made.parent)} == {0o700}


NOTED = """
import subprocess, sys
from hapticdb.cli.render import noting_warnings

with noting_warnings():
    from hapticdb.kernels._cache import CACHE_FOLDER
print(CACHE_FOLDER, flush=True)
if len(sys.argv) == 1:
    subprocess.run([sys.executable, __file__, "started"], check=True)
"""


def test_a_process_without_a_folder_says_so_in_a_line_and_removes_its_own(folders: Path) -> None:
    Path(cache_folder()).chmod(0o777)
    (folders / f"temporary/hapticdb-{os.geteuid()}").touch()
    script = folders / "script.py"
    script.write_text(NOTED)
    env = os.environ | {"TMPDIR": str(folders / "temporary")}
    done = finished([sys.executable, str(script)], env=env, check=True)
    own, started = done.stdout.splitlines()
    assert own == started
    assert Path(own).parent == folders / "temporary"
    assert not Path(own).exists()
    assert done.stderr.startswith(f"hapticdb: compiled kernels are not kept in {folders}/cache/")
    assert done.stderr.count("\n") == 1


LOADED = """
import sys
from hapticdb.kernels.compiling import load
load(["rigid.first_not_rigid"])
print("numba.np.linalg" in sys.modules)
"""


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="without JIT none is on disk")
def test_a_kernel_on_disk_is_loaded_without_what_numba_compiles_with() -> None:
    """Else each process would start half a second later."""
    first, second = (finished([sys.executable, "-c", LOADED], check=True) for _ in range(2))
    assert (first.stdout.strip(), second.stdout.strip()) == ("True", "False")


class StrangerNumbers(NamedTuple):
    """Numbers of a user's law; all are of one kind, which makes them another type of numba's."""

    stiffness: float


def test_machine_code_for_a_type_from_outside_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that cannot import its module could read nothing of that entry."""
    kept: list[object] = []
    monkeypatch.setattr(FunctionCache, "save_overload", lambda _, sig, __: kept.append(sig))
    cache, law = object.__new__(_Cache), numba.typeof(StrangerNumbers(1.0))
    cache.save_overload((types.int64, law), None)
    cache.save_overload((types.int64, types.CPointer(law)), None)
    assert kept == []
    cache.save_overload((types.int64, types.CPointer(types.int64)), None)
    assert len(kept) == 1
