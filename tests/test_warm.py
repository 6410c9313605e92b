"""After `warm_up` nothing is compiled any more."""

import json
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
from hapticdb.kernels import _jit
from hapticdb.query import STRATEGIES
from hapticdb.testing import KINDS, floor_voxels, write_voxels

def signatures():
    return {f"{e.py_func.__module__}.{e.py_func.__name__}": len(e.signatures) for e in _jit.ENTRIES}

hapticdb.warm_up()
before = signatures()
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
                env.touch(each, np.eye(4), strategy, exclude=[1]).pairs
                env.touch(each, np.eye(4), strategy).pairs
        env.calibrate()
        env.move(1, np.eye(4))
        env.voxels(1)
        env.remove(1)
        write_voxels(env.store, floor_voxels(env.grid))
        env.touch(shell, np.eye(4)).pairs
after = signatures()
print(json.dumps({"before": before, "after": after}))
"""


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="the JIT is off: nothing compiles")
def test_warm_up_leaves_nothing_to_compile(tmp_path: Path) -> None:
    done = finished([sys.executable, "-c", SCRIPT, str(tmp_path)], check=True)
    counted = json.loads(done.stdout)
    assert counted["after"] == counted["before"]
    assert all(counted["before"].values()), "an entry that warm_up never calls"
