"""A tool, its coupling and resident cells, for tests that set the handle's pose themselves."""

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

import hapticdb
from closed_forms import field_of, plane
from hapticdb import Environment, Grid, PointShell
from hapticdb.kernels.hand import coupling as kernels
from hapticdb.kernels.hand.anchors import MET_ROWS
from hapticdb.kernels.records import MOST_MISSED, SERVO, pose_numbers, views_of
from hapticdb.kernels.resident.cells import spread_key
from hapticdb.kernels.rigid import poses_of
from hapticdb.realtime.coupling import Coupling
from hapticdb.resident.frames import clusters_of
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.testing import write_voxels
from realtime.worlds import cells_of

Floats = NDArray[np.float64]
SIZE = 0.005
"""Voxel size in metres."""
BITS = 6
SIDE = 1 << BITS
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


class World:
    """Voxels of 5 mm about the world's origin; no cell is resident if `is_known` is false."""

    def __init__(self, ijk: ArrayLike = (), *, is_known: bool = True) -> None:
        self.grid = Grid(SIZE, (-SIZE * SIDE / 2,) * 3, BITS)
        self._folder = tempfile.TemporaryDirectory()
        path = Path(self._folder.name) / "world.db"
        self.environment: Environment = hapticdb.create(path, self.grid)
        voxels = np.asarray(ijk, dtype=np.int64).reshape(-1, 3)
        self.occupied = np.zeros((SIDE,) * 3, dtype=np.bool_)
        self.occupied[tuple(voxels.T)] = True
        if len(voxels):
            write_voxels(self.environment.store, voxels)
        self.table = CellTable.create(4 << 20)
        self.residency = Residency(self.environment.store, self.table)
        if is_known:
            self.load(cells_of(self.grid))

    def load(self, cells: NDArray[np.int64]) -> None:
        while len(missing := self.residency.missing(cells)):
            self.residency.load(missing)

    def close(self) -> None:
        self.environment.close()
        self.table.close()
        self._folder.cleanup()


class SmoothWorld:
    """Cells of a `World`'s size with distances: full below z = 0."""

    def __init__(self) -> None:
        field = field_of(plane((0.0, 0.0, 1.0)), SIZE)
        self.grid = Grid(SIZE, (-SIZE * SIDE / 2,) * 3, BITS)
        self.table = CellTable.create(4 << 20, distances=True)
        cells = self.table.cells
        is_cell = field.cells.keys[0] >= 0
        for key, slot in zip(
            field.cells.keys[0, is_cell], field.cells.slots[0, is_cell], strict=True
        ):
            at = int(spread_key(key, np.int64(self.table.capacity)))
            while cells.keys[0, at] >= 0:
                at = (at + 1) % self.table.capacity
            cells.keys[:, at], cells.slots[:, at] = key, slot
        for name in ("words", "masks", "payload"):
            filled = getattr(field.cells, name)
            getattr(cells, name)[: len(filled)] = filled

    def close(self) -> None:
        self.table.close()


class Tool:
    """A shell with its coupling; the test sets the handle's pose."""

    def __init__(
        self,
        world: World,
        shell: PointShell,
        position: ArrayLike,
        *,
        quaternion: ArrayLike = UPRIGHT,
        contact: float = 1000.0,
        coupling: Coupling | None = None,
    ) -> None:
        self.world = world
        self.shell = shell
        self.place = world.residency.place
        self.clusters = clusters_of(shell, SIZE)
        self.body = (coupling or Coupling()).body(shell, self.place, contact)
        self.row = world.table.join()
        self.servo = np.zeros((), SERVO)
        views = views_of(self.servo)
        self.state, self.hand, self.sent = views.tool, views.hand, views.sent
        self.state.position[:] = self.hand.position[:] = position
        self.state.quaternion[:] = self.hand.quaternion[:] = quaternion
        self.frame: Floats = self.state.felt
        self.met = np.empty((MET_ROWS, len(shell)), dtype=np.int64)
        self.missed = np.zeros(1 + MOST_MISSED, dtype=np.int64)

    def advance(self, dt: float = 1e-3) -> None:
        kernels.advance(
            self.world.table.cells, self.row, self.clusters, self.place, self.body, self.servo, dt,
            self.met, self.missed,
        )  # fmt: skip

    def settle(self, seconds: float, rate: float = 1000.0) -> None:
        for _ in range(round(seconds * rate)):
            self.advance(1.0 / rate)

    @property
    def pose(self) -> Floats:
        pose: Floats = np.empty((1, 4, 4))
        poses_of(self.placed[None], pose)
        return pose.reshape(4, 4)

    @property
    def voxels(self) -> NDArray[np.int64]:
        """Voxel of each point (N, 3), also outside the grid."""
        placed = self.shell.points @ self.pose[:3, :3].T + self.pose[:3, 3]
        voxels: NDArray[np.int64] = np.floor(placed / SIZE + SIDE / 2).astype(np.int64)
        return voxels

    @property
    def placed(self) -> Floats:
        """Position and unit quaternion (7,)."""
        return pose_numbers(self.servo["tool"])

    @property
    def n_hits(self) -> int:
        return int(self.sent.hits)

    @property
    def flags(self) -> int:
        return int(self.sent.marks)

    @property
    def is_at_rest(self) -> bool:
        speed = np.linalg.norm(self.state.velocity[:3])
        turning = np.linalg.norm(self.state.velocity[3:]) * self.body.radius
        return bool(speed + turning < 1e-4)


def numbers_in(record: NDArray[np.void]) -> Floats:
    """All numbers of a record (), including those of nested records."""
    fields = [record[name] for name in record.dtype.names or ()]
    return np.concatenate(
        [numbers_in(field) if field.dtype.names else field.ravel() for field in fields]
    )


def box(size: ArrayLike, points: int = 200) -> PointShell:
    """A box about the tool's origin."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return PointShell.from_mesh(corners * (np.asarray(size) / 2.0), faces, points)


def punch(n_across: int, pitch: float = 0.002) -> PointShell:
    """A flat square of points, facing down."""
    across = (np.arange(n_across) - (n_across - 1) / 2.0) * pitch
    x, y = np.meshgrid(across, across, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.zeros(n_across**2)], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return PointShell(points, normals, np.zeros(3), is_closed=False)
