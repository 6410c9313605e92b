"""After `warm_up` nothing is compiled, and each verb compiles only the kernels that it uses."""

import fnmatch
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numba
import pytest

from children import finished
from command_line import command
from hapticdb import ready
from hapticdb.kernels import compiling
from hapticdb.kernels.compiling import NAMES, PURPOSES, entries_for, jobs_of

SCRIPT = """
import json, sys
from pathlib import Path
import numpy as np
import hapticdb
from hapticdb.devices.scripted import RandomHand
from hapticdb.kernels import _jit, compiling
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from voxels import KINDS, floor_voxels, write_voxels

def name(entry):
    module = entry.py_func.__module__.removeprefix("hapticdb.kernels.")
    return f"{module}.{entry.py_func.__name__}"

hapticdb.warm_up()
folder = Path(sys.argv[1])
stl = folder / "part.stl"
facets = np.array([[[0, 0, 0], [0, 1, 0], [1, 0, 0]], [[0, 0, 0], [1, 0, 0], [0, 0, 1]],
                   [[0, 0, 0], [0, 0, 1], [0, 1, 0]], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]])
lines = ["solid part"]
for facet in facets:
    lines += ["facet normal 0 0 0", "outer loop"]
    lines += ["vertex %d %d %d" % tuple(v) for v in facet]
    lines += ["endloop", "endfacet"]
stl.write_text("\\n".join(lines + ["endsolid part", ""]))
shell = hapticdb.PointShell.from_file(stl, points=300)
shell.save(folder / "shell.npz")
loaded = hapticdb.PointShell.from_file(folder / "shell.npz")
for n, (layout, curve) in enumerate(KINDS):
    url = folder / f"{n}.db"
    grid = hapticdb.GridOptions(bits=6, curve=curve)
    hapticdb.import_files(url, [stl], hapticdb.ImportOptions(grid=grid, layout=layout))
    with hapticdb.open(url) as env:
        for strategy in STRATEGIES:
            for each in (shell, loaded):
                env.touch(each, np.eye(4), strategy, exclude=[1], law="plane").pairs
                env.touch(each, np.eye(4), strategy, law="plane").pairs
                if env.has_distances and strategy != "statement":
                    env.touch(each, np.eye(4), strategy).contact_pairs
        env.calibrate()
        hapticdb.sweep(env, shell, [np.diag([-1.0, -1.0, 1.0, 1.0]), np.eye(4)])
        env.move(1, np.eye(4))
        env.voxels(1)
        env.remove(1)
        write_voxels(env.store, floor_voxels(env.grid))
        env.touch(shell, np.eye(4)).pairs
        if curve != "lexicographic":
            with CellTable.create(LEAST_BUDGET) as table:
                frames = ResidentFrames(Residency(env.store, table), shell, run=4)
                frames.feel(np.eye(4)[None])
                frames.close()
            point = hapticdb.PointShell(shell.points[:1], shell.normals[:1], shell.center)
            for each in (shell, loaded, point):
                env.touch(each, poses=[np.eye(4)], objects=True)
                env.clearance(each, [np.eye(4)])
                env.collides(each, [np.eye(4)])
hand = RandomHand(np.zeros(3))
distance = folder / "distance.db"
hapticdb.import_files(distance, [stl], hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=6)))
for url, law in ((folder / "0.db", "plane"), (distance, "distance")):
    with hapticdb.Session(
        str(url), shell, hand, law=law, seconds=0.3, has_baseline=False
    ) as session:
        assert session.law.name == law
        report = session.wait(60)
    assert report is not None and report.loop.frames > 0
assert set(_jit.SIGNATURES) == set(compiling.NAMES)
found = {name(entry): [sorted(map(str, entry.signatures)),
                       sorted(str(tuple(s)) for n, s in _jit.SIGNATURES.items()
                              if n.partition("@")[0] == name(entry))]
         for entry in _jit.ENTRIES}
print(json.dumps(found))
"""


NEEDS_JIT = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="without JIT none compiles")


@NEEDS_JIT
@pytest.mark.long
def test_warm_up_leaves_nothing_to_compile(tmp_path: Path) -> None:
    """Every entry has only its declared signatures, whatever is called after `warm_up`.

    A session's loop runs in its own process and raises an error if a kernel is compiled while it
    runs (`realtime.loop.work`).
    """
    paths = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = finished([sys.executable, "-c", SCRIPT, str(tmp_path)], env=paths, check=True)
    found = json.loads(done.stdout)
    assert set(found) == {name.partition("@")[0] for name in NAMES}
    assert {name: both for name, both in found.items() if both[0] != both[1]} == {}


def test_a_purpose_names_entries_that_exist() -> None:
    for purpose, patterns in PURPOSES.items():
        for pattern in patterns:
            assert fnmatch.filter(NAMES, pattern), (purpose, pattern)
    assert entries_for("everything") == list(NAMES)
    assert sorted(name for job in jobs_of(NAMES) for name in job) == sorted(NAMES)


FEEL = "feel a.db --tool s/wrench.stl --device s/path.csv --seconds 0.5 --record a.hdbrec"
VERBS: tuple[tuple[str, str], ...] = (
    ("", "sample s --frames 20"),
    ("import", "import a.db s/car.glb --bits 7"),
    ("shell,touch by distance", "touch a.db --tool s/wrench.stl --poses s/path.csv"),
    ("feel,coupling", FEEL),
    ("resident,coupling", "replay a.hdbrec a.db"),
    ("sweep", "sweep a.db --tool s/wrench.stl --path s/path.csv"),
    ("extract", "extract a.db 12 --motions 0 --out 100"),
    ("move", "move a.db 12 --translate 0,0,0.001"),
    ("copy", "copy a.db b.db --layout voxel --curve hilbert"),
    ("copy", "diff a.db b.db"),
    ("calibrate", "info a.db --calibrate"),
)


@NEEDS_JIT
@pytest.mark.long
def test_a_verb_compiles_its_own_kernels_once_and_says_so(tmp_path: Path) -> None:
    """From an empty cache, numba stores exactly the kernels that the verbs' purposes name."""
    env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    so_far: set[str] = set()
    for purpose, words in VERBS:
        done = finished(command(*words.split()), cwd=tmp_path, env=env)
        assert done.returncode in {0, 1, 3}, done.stderr  # 1: a sweep hits, 3: not all is proved
        wanted = so_far | set(entries_for(*purpose.split(",")) if purpose else ())
        n_new = len(wanted - so_far)
        assert done.stderr.count("once on this machine") == (n_new > 0), words
        found = {path.name.partition("-")[0] for path in (tmp_path / "cache").rglob("*.nbi")}
        # numba's file names lack the package names; there is a file of code for each signature
        entries = {".".join(entry.partition("@")[0].split(".")[-2:]) for entry in wanted}
        assert found == entries, words
        assert len(list((tmp_path / "cache").rglob("*.nbc"))) == len(wanted), words
        so_far = wanted
    done = finished(command("warm"), env=env)
    ready = f"{len(NAMES)} kernels ready:"
    assert done.stdout.startswith(f"{ready} {len(NAMES) - len(so_far)} compiled now")
    assert finished(command("warm"), env=env).stdout.startswith(f"{ready} 0 compiled now")


@NEEDS_JIT
@pytest.mark.parametrize("change", ["another copy", "another time"])
def test_what_another_copy_of_the_package_has_compiled_is_missing_here(
    tmp_path: Path, change: str
) -> None:
    """numba keeps code by the path and the time of its source, even where sources are equal."""
    copies = [tmp_path / name / "hapticdb" for name in ("first", "second")]
    for copy in copies:
        shutil.copytree(Path(compiling.__file__).parents[1], copy)  # with the sources' times
    told = []
    for n, work in enumerate(["compile_missing(names)", "0", "0"]):
        copy = copies[n == 2 and change == "another copy"]
        if n == 2 and change == "another time":
            os.utime(copy / "kernels" / "rigid.py", (1e9, 1e9))
        code = (
            "from hapticdb.kernels.compiling import compile_missing, missing; "
            f"names = ['rigid.first_not_rigid']; {work}; print(missing(names))"
        )
        cache = {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(copy.parent)}
        done = finished([sys.executable, "-c", code], env=os.environ | cache, check=True)
        told.append(done.stdout.strip())
    assert told == ["[]", "[]", "['rigid.first_not_rigid']"]


@NEEDS_JIT
@pytest.mark.parametrize("fault", ["dies", "is not there"])
def test_a_process_that_cannot_compile_leaves_it_to_the_first_call(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, fault: str
) -> None:
    monkeypatch.setattr(compiling, "CACHE_FOLDER", str(tmp_path))
    monkeypatch.setattr(sys, "executable", "/bin/false" if fault == "dies" else "/no/such/python")
    told: list[compiling.Compiled] = []
    names = entries_for("import")
    assert compiling.compile_missing(names, told.append) == len(names)
    assert (told[0].done, told[-1].done) == (0, len(names))
    assert compiling.missing(names) == names


@NEEDS_JIT
def test_compiling_that_is_interrupted_ends_its_processes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(compiling, "CACHE_FOLDER", str(tmp_path))
    monkeypatch.setattr(compiling, "SERVE", "import time; time.sleep(600)")
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
        compiling.compile_missing(entries_for("import"))
    assert started
    for pid in started:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@NEEDS_JIT
@pytest.mark.parametrize(
    "words", ["import a.db none.stl", "feel a.db --tool none.stl --device p.csv"]
)
def test_nobody_waits_for_kernels_to_hear_that_a_file_is_missing(
    tmp_path: Path, words: str
) -> None:
    env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    (tmp_path / "p.csv").write_text("x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0\n0,0,1,1,0,0,0\n")
    done = finished(command(*words.split()), cwd=tmp_path, env=env)
    assert done.returncode == 2
    assert "compiling" not in done.stderr
    assert "none.stl" in done.stderr
    assert not list((tmp_path / "cache").rglob("*.nbi"))


def test_compiling_is_told_in_one_line_and_happens_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    compiled: list[str] = []

    def compile_missing(names: Collection[str], _: object) -> int:
        compiled.extend(names)
        return len(names)

    monkeypatch.setattr(ready, "_READY", set())
    monkeypatch.setattr(ready, "missing", lambda names: [n for n in names if n not in compiled])
    monkeypatch.setattr(ready, "compile_missing", compile_missing)
    for _ in range(2):
        ready.make_ready("shell")
    assert capsys.readouterr().err.count("\n") == 1
    assert "curves.encode_kernel" in compiled
    assert len(compiled) == len(set(compiled))
