"""Sets of machine code: the one that came is used where it fits; else one is built, once."""

import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import MagicMock

import numba
import pytest
from numba import types

from children import finished
from hapticdb.kernels import _building, _machine_code, _sets
from hapticdb.kernels._jit import ENTRIES, _Kept
from hapticdb.kernels._machine_code import built_for, digest_of
from hapticdb.kernels._sets import SHIPPED, code_of, fitting_set

NEEDS_JIT = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="without JIT none compiles")
ENTRY = "rigid.first_not_rigid"


class Folders(NamedTuple):
    """The package's set, and where the user's is."""

    shipped: Path
    cache: Path

    @property
    def own(self) -> Path:
        return self.cache / f"kernels-{_machine_code.build()}-frames"


def write_set(folder: Path, **other: str) -> None:
    """Write a set of one entry, for this process but for what is given."""
    folder.mkdir(parents=True)
    (folder / ENTRY).write_bytes(b"code")
    entries = {ENTRY: digest_of(b"code")}
    manifest = {"for": built_for() | other, "entries": entries}
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Folders]:
    found = Folders(tmp_path / "_machine/frames", tmp_path / "cache")
    monkeypatch.setattr(_sets, "SHIPPED", found.shipped.parent)
    monkeypatch.setattr(_sets, "cache_folder", lambda: found.cache)
    fitting_set.cache_clear()
    yield found
    fitting_set.cache_clear()


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Folders whose sets were built, without compiling."""
    made: list[Path] = []

    def build_set(folder: Path, group: str) -> None:
        assert group == "frames"
        made.append(folder)
        write_set(folder)

    monkeypatch.setattr(_building, "build_set", build_set)
    return made


def test_code_of_shipped_set(
    folders: Folders, built: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user's cache is not made for it."""
    cache_folder = MagicMock()
    monkeypatch.setattr(_sets, "cache_folder", cache_folder)
    write_set(folders.shipped)
    assert code_of(ENTRY) == b"code"
    assert code_of("rigid.other") is None
    assert built == []
    assert not cache_folder.called


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        ({}, "none came with this copy"),
        ({"numba": "0.1"}, f"those that came are for numba 0.1, here is {numba.__version__}"),
        ({"numpy": "1.0"}, "those that came are for numpy 1.0"),
        ({"Python": "cpython-30"}, "those that came are for Python cpython-30"),
        ({"system": "Linux m68k"}, "those that came are for system Linux m68k"),
        ({"processor": "x86-64-v9"}, "those that came are for processor x86-64-v9"),
        ({"sources": "0"}, "those that came are for other sources"),
    ],
)
def test_fitting_set_mismatch_built_once(
    folders: Folders,
    built: list[Path],
    capsys: pytest.CaptureFixture[str],
    other: dict[str, str],
    reason: str,
) -> None:
    if other:
        write_set(folders.shipped, **other)
    for _ in range(2):  # of processes
        fitting_set.cache_clear()
        assert code_of(ENTRY) == b"code"
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "compiling kernels (frames), once on this machine" in said
    assert f"({reason}" in said
    assert built == [folders.own]


@pytest.mark.parametrize("content", ["", "[]", "{", '{"for": 1}', "\0"])
def test_fitting_set_damaged_manifest(folders: Folders, built: list[Path], content: str) -> None:
    write_set(folders.shipped)
    (folders.shipped / "manifest.json").write_text(content)
    assert code_of(ENTRY) == b"code"
    assert built == [folders.own]


def test_code_of_damaged_code(folders: Folders, built: list[Path]) -> None:
    write_set(folders.shipped)
    (folders.shipped / ENTRY).write_bytes(b"cod")
    assert code_of(ENTRY) is None
    assert built == []


@NEEDS_JIT
@pytest.mark.parametrize("fault", ["dies", "is not there", "has no folder"])
def test_code_of_build_failure_compiles_in_place(
    folders: Folders,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    fault: str,
) -> None:
    if fault == "has no folder":
        folders.cache.touch()
    else:
        python = "/bin/false" if fault == "dies" else "/no/such/python"
        monkeypatch.setattr(sys, "executable", python)
    assert code_of(ENTRY) is None
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 2
    assert told[1].startswith("hapticdb: each kernel is compiled when it is first called: ")
    assert not folders.own.exists()


@NEEDS_JIT
def test_build_set_interrupted_leaves_nothing(
    folders: Folders, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_building, "SERVE", "import time; time.sleep(600)")
    started: list[int] = []
    real = subprocess.Popen

    def remembered(*args: Any, **options: Any) -> Any:  # noqa: ANN401 - handed on
        process = real(*args, **options)
        started.append(process.pid)
        if len(started) == 1:
            threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
        return process

    monkeypatch.setattr(subprocess, "Popen", remembered)
    with pytest.raises(KeyboardInterrupt):
        fitting_set("frames")
    assert started
    for pid in started:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    assert [path.suffix for path in folders.cache.iterdir()] == [".lock"]


LOADED = """
import sys
import numpy as np
from hapticdb.kernels import rigid
rigid.first_not_rigid(np.eye(4)[None])
print("numba.np.linalg" in sys.modules, rigid.__file__)
"""


@NEEDS_JIT
def test_fitting_set_shipped_needs_no_cache_or_compiler(
    tmp_path: Path,
) -> None:
    """As an installed wheel: else each process would start half a second later."""
    fitting_set.cache_clear()
    found = fitting_set("frames")
    assert found is not None
    package = tmp_path / "hapticdb"
    unwanted = shutil.ignore_patterns("__pycache__", "_machine")
    shutil.copytree(Path(_machine_code.__file__).parents[1], package, ignore=unwanted)
    shutil.copytree(found[0], package / "kernels" / SHIPPED.name / "frames")
    env = os.environ | {"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    done = finished([sys.executable, "-c", LOADED], env=env, check=True)
    assert done.stdout.strip() == f"False {package}/kernels/rigid.py"
    assert done.stderr == ""
    assert list((tmp_path / "cache").rglob("kernels-*")) == []


class StrangerNumbers(NamedTuple):
    """Numbers of a user's law; all are of one kind, which makes them another type of numba's."""

    stiffness: float


@NEEDS_JIT
def test_load_overload_users_law_compiled_in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are compiled in place."""
    asked: list[str] = []
    monkeypatch.setattr("hapticdb.kernels._jit.code_of", asked.append)
    name = "query.refining.refine"
    importlib.import_module(f"hapticdb.kernels.{name.rpartition('.')[0]}")
    kept, signature = _Kept(name), ENTRIES[name].signature
    strange = tuple(
        numba.typeof(StrangerNumbers(1.0)) if isinstance(kind, types.BaseTuple) else kind
        for kind in signature
    )
    assert kept.load_overload(strange, None) is None
    assert asked == []
    assert kept.load_overload(signature, None) is None
    assert kept.load_overload(ENTRIES[f"{name}@distances"].signature, None) is None
    assert asked == [name, f"{name}@distances"]
