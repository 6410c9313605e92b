"""Compiles every kernel with the types that it meets in production, so that no frame waits."""

import tempfile
from pathlib import Path

import numpy as np

from hapticdb.environment import create
from hapticdb.grid import Grid
from hapticdb.ingest import rows_of_part
from hapticdb.layout import rows_of_voxels
from hapticdb.mesh import Part
from hapticdb.pointshell import PointShell
from hapticdb.query import STRATEGIES
from hapticdb.store.base import Layout, Object

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float64)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int64)


def warm_up() -> None:
    """Compile every kernel, or load it from the cache, by using each once on a small scene.

    Takes half a minute on a machine that never did it, and a second or two later. Afterwards no
    import and no touch compiles anything (`tests/test_warm.py`).
    """
    # a body with another inside: which of them is a void is asked only where there are two
    corners = np.concatenate([CORNERS, 0.1 + 0.1 * CORNERS])
    shell = PointShell.from_mesh(corners, np.concatenate([FACES, FACES + 4]), points=12)
    kinds: tuple[tuple[Layout, Grid], ...] = (
        ("brick", Grid(0.1, (-1, -1, -1), 5)),
        ("voxel", Grid(0.1, (-1, -1, -1), 5, "hilbert")),
    )
    with tempfile.TemporaryDirectory() as folder:
        for layout, grid in kinds:
            with create(Path(folder) / f"{layout}.db", grid, layout=layout) as env:
                for name, faces in (("mesh", FACES), ("cloud", None)):
                    part = Part(name, CORNERS, faces, np.eye(4))
                    rows, n_voxels = rows_of_part(part, grid, layout)
                    obj = Object(
                        name=name,
                        link="made",
                        digest=part.digest,
                        transform=np.eye(4),
                        voxels=n_voxels,
                        bounds=part.bounds,
                    )
                    env.voxels(env.store.add(obj, rows))
                rows_of_voxels(grid.voxels_of(CORNERS), grid, layout)
                for strategy in STRATEGIES:
                    assert env.touch(shell, np.eye(4), strategy).pairs.shape[1] == 2  # noqa: S101
                env.quantiles(4).rows_between(0, 10)
                grid.decode(grid.encode(grid.voxels_of(CORNERS)))
