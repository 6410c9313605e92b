"""Nothing is compiled where all has been built: entries are called with their declared types."""

import json
import os
import sys
from pathlib import Path

import numba
import pytest

from children import finished

SCRIPT = """
import json, sys
from pathlib import Path
import numpy as np
import hapticdb
from hapticdb.devices.scripted import RandomHand
from hapticdb.kernels import _jit
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import LEAST_BUDGET, CellTable
from voxels import KINDS, floor_voxels, write_voxels

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
quarter = np.eye(4)[[1, 0, 2, 3]] * [[-1.0], [1.0], [1.0], [1.0]]
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
        hapticdb.sweep(env, shell, [np.diag([-1.0, -1.0, 1.0, 1.0]), quarter, np.eye(4)])
        env.move(1, np.eye(4))
        env.voxels(1)
        env.remove(1)
        write_voxels(env.store, floor_voxels(env.grid))
        env.touch(shell, np.eye(4)).pairs
        if curve != "lexicographic":
            with CellTable.create(LEAST_BUDGET) as table:
                frames = ResidentFrames(Residency(env.store, table), shell, run=4)
                frames.evaluate(np.eye(4)[None])
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
declared = {}
for name, entry in _jit.ENTRIES.items():
    declared.setdefault(name.partition("@")[0], []).append(entry)
others = {name: [str(s) for s in entries[0].compiled.signatures
                 if s not in {entry.signature for entry in entries}]
          for name, entries in declared.items()}
print(json.dumps({name: found for name, found in others.items() if found}))
print(len(declared))
"""


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="without JIT none compiles")
@pytest.mark.long
def test_entries_called_with_declared_types(tmp_path: Path) -> None:
    """So nothing is compiled in place: sets have the machine code of declared types.

    A session's loop runs in its own process and raises an error if a kernel is compiled while it
    runs (`session.device_loop`).
    """
    paths = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = finished([sys.executable, "-c", SCRIPT, str(tmp_path)], env=paths, check=True)
    others, count = done.stdout.splitlines()
    assert json.loads(others) == {}
    assert int(count) > 40
