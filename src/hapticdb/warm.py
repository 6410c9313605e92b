"""Compiles every kernel with the types that it meets in production, so that no frame waits."""

import os
import tempfile
from pathlib import Path

import numpy as np

from hapticdb.environment import Environment, create
from hapticdb.grid import Grid
from hapticdb.ingest import rows_of_part
from hapticdb.layout import rows_of_voxels
from hapticdb.mesh import Part
from hapticdb.pointshell import PointShell
from hapticdb.query import STRATEGIES
from hapticdb.realtime.coupling import Coupling
from hapticdb.realtime.deadlines import Timing
from hapticdb.realtime.devices import Line, RandomHand
from hapticdb.realtime.frames import Frames
from hapticdb.realtime.handle import Handle
from hapticdb.realtime.loop import Loop, LoopRequest, ring_bytes
from hapticdb.realtime.prefetch import Fetching, FetchRequest
from hapticdb.realtime.residency import Residency
from hapticdb.realtime.simulated import SimulatedDevice
from hapticdb.realtime.sweep import sweep
from hapticdb.realtime.table import LEAST_BUDGET, CellTable, anonymous_memory
from hapticdb.store.base import Layout, Object

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float64)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int64)


def warm_up() -> None:
    """Compile every kernel, or load it from the cache, by using each once on a small scene.

    Takes a minute or two on a machine that never did it, and a few seconds later. Afterwards no
    import, touch, session or sweep compiles anything (`tests/test_warm.py`).
    """
    # a body with another inside: which of them is a void is asked only where there are two
    corners = np.concatenate([CORNERS, 0.1 + 0.1 * CORNERS])
    shell = PointShell.from_mesh(corners, np.concatenate([FACES, FACES + 4]), points=12)
    kinds: tuple[tuple[Layout, Grid], ...] = (
        ("brick", Grid(0.1, (-1, -1, -1), 6)),
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
                _feel(env, shell)


def _feel(env: Environment, shell: PointShell) -> None:
    """Run frames, a path and a session's loop against resident cells."""
    with CellTable.create(LEAST_BUDGET) as table:
        residency = Residency(env.store, table)
        frames = Frames(residency, shell, run=4)
        frames.feel(np.eye(4)[None])
        frames.close()
        with CellTable.create(LEAST_BUDGET) as other:
            request = FetchRequest(env.url, other.descriptor, other.n_slots, env.grid)
            fetching = Fetching(request)
            fetching.warm_up()
            fetching.store.close()
        memory = anonymous_memory("hapticdb-frames", ring_bytes(4))
        with table.reading() as row:
            loop = LoopRequest(
                descriptor=table.descriptor,
                n_slots=table.n_slots,
                row=row,
                ring=memory,
                n_ring=4,
                grid=env.grid,
                shell=shell,
                device=SimulatedDevice(RandomHand((0.0, 0.0, 0.0))),
                stiffness=1000.0,
                coupling=Coupling(),
                handle=Handle(start=(0.0, 0.0, 0.0)),
                timing=Timing(),
                seconds=1.0,
                staleness=1.0,
                is_waiting=False,
            )
            Loop(loop).warm_up()
        os.close(memory)
        sweep(env, shell, [np.eye(4), np.eye(4)], profile=True)
        sweep(env, shell, [np.diag([-1.0, -1.0, 1.0, 1.0]), np.eye(4)])
        sweep(env, shell, [np.eye(4)] * 2, exclude=[obj.id for obj in env.objects()])
        Line((0.0, 0.0, 0.0), (0.1, 0.0, 0.0)).read()
