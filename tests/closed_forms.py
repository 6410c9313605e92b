"""Resident cells filled from closed-form distances, and a hand that drives a tool in them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bands import steps_of
from hapticdb.grid import Grid
from hapticdb.kernels.field.lattice import BEYOND, CELL_SIDE, CELL_VALUES, HALF_WIDTH, STEPS
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.records.cells import CONTROL, READER, REQUEST
from hapticdb.kernels.records.layout import pose_numbers, views_of
from hapticdb.kernels.resident.cells import (
    SCRATCH_ROWS,
    CellGrid,
    Cells,
    Clusters,
    key_of_cell,
    spread_key,
)
from hapticdb.kernels.resident.near_voxels import mark_near_voxels
from hapticdb.poses import rotation_of
from hapticdb.query.law import DISTANCE
from hapticdb.resident.point_runs import spheres_of
from hapticdb.session.states import PeriodClock, SessionState

Floats = NDArray[np.float64]
Distance = Callable[[Floats], Floats]
"""Distances (M,) in metres at points (M, 3), metres."""
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
EVERYWHERE = 1024


# --- distances ----------------------------------------------------------------------------------


def plane(normal: ArrayLike, offset: float = 0.0) -> Distance:
    """Distance to the half space below a plane: 0 inside, as if it were full of surfaces."""
    unit = np.asarray(normal, float) / np.linalg.norm(normal)
    return lambda p: np.maximum(p @ unit - offset, 0.0)


def sheet(normal: ArrayLike, offset: float = 0.0) -> Distance:
    """Distance to a plane without thickness."""
    unit = np.asarray(normal, float) / np.linalg.norm(normal)
    return lambda p: np.abs(p @ unit - offset)


def plate(normal: ArrayLike, thickness: float) -> Distance:
    """Distance to both faces of a plate about the origin."""
    unit = np.asarray(normal, float) / np.linalg.norm(normal)
    return lambda p: np.abs(np.abs(p @ unit) - thickness / 2.0)


def wedge(angle: float) -> Distance:
    """Distance to a full convex edge along y: its faces fall by `angle` / 2 from the top, radians.

    angle: between the faces, inside the material.
    """
    a = np.array([np.sin(angle / 2.0), -np.cos(angle / 2.0)])  # down the right face, in (x, z)

    def distance(p: Floats) -> Floats:
        x, z = np.abs(p[:, 0]), p[:, 2]
        along = np.maximum(x * a[0] + z * a[1], 0.0)
        gap = np.hypot(x - along * a[0], z - along * a[1])
        is_inside = -z * np.tan(angle / 2.0) > x
        return np.where(is_inside, 0.0, gap)

    return distance


def corner() -> Distance:
    """Distance to the material outside the octant x, z > 0 of all y: a concave edge along y."""
    return lambda p: np.maximum(np.minimum(p[:, 0], p[:, 2]), 0.0)


def cylinder(radius: float) -> Distance:
    """Distance to a full cylinder along y."""
    return lambda p: np.maximum(np.hypot(p[:, 0], p[:, 2]) - radius, 0.0)


def hole(radius: float) -> Distance:
    """Distance to the wall of a round hole along z, full outside."""
    return lambda p: np.maximum(radius - np.hypot(p[:, 0], p[:, 1]), 0.0)


def moved(distance: Distance, by: ArrayLike) -> Distance:
    """The same distance with everything shifted."""
    shift = np.asarray(by, float)
    return lambda p: distance(p - shift)


# --- resident cells -----------------------------------------------------------------------------


class Field(NamedTuple):
    """Resident cells and the grid in which they lie, about the world's origin."""

    cells: Cells
    place: CellGrid
    distance: Distance


def field_of(distance: Distance, size: float, n_cells: ArrayLike = (2, 2, 2)) -> Field:
    """Cells (n, n, n) of a distance, all resident, about the origin; size: voxel size, metres."""
    counts = np.broadcast_to(np.asarray(n_cells), (3,))
    side = int(counts.max()) * 32
    origin = -0.5 * side * size
    keys = np.full((3, EVERYWHERE), -1, dtype=np.int64)
    slots = np.zeros((3, EVERYWHERE), dtype=np.int32)
    payload, words = [np.full(CELL_VALUES, BEYOND, np.uint8)], [np.zeros(1024, np.uint32)]
    masks = [0]
    steps = np.arange(-1, CELL_SIDE - 1)
    first = (side // 32 - counts) // 2
    for cell in np.ndindex(*counts):
        at = np.asarray(cell) + first
        axes = [origin + size * (32 * at[axis] + steps + 0.5) for axis in range(3)]
        centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        values = steps_of(distance(centers) / size)
        slot = 0
        if (values != BEYOND).any():
            slot = len(payload)
            payload.append(values)
            words.append(words_of(values))
            masks.append(mask_of(values))
        enter(keys, slots, key_of_cell(*(int(n) for n in at)), slot)
    keys[1:], slots[1:] = keys[0], slots[0]
    control = np.zeros((), CONTROL)
    control["version"] = 3
    near = np.zeros((len(payload), 1024), dtype=np.uint32)
    cells = Cells(
        control, np.zeros(16, READER), keys, slots, np.array(words),
        np.array(masks, dtype=np.uint64), np.zeros(len(payload), dtype=np.uint8),
        np.array(payload), near,
    )  # fmt: skip
    filled = np.arange(1, len(payload))
    mark_near_voxels(filled, np.array(payload), cells.masks, cells.words, near)
    return Field(cells, CellGrid(origin, origin, origin, size, float(side)), distance)


def enter(keys: NDArray[np.int64], slots: NDArray[np.int32], key: int, slot: int) -> None:
    """Enter a cell in directory 0."""
    at = int(spread_key(np.int64(key), np.int64(EVERYWHERE)))
    while keys[0, at] >= 0:
        at = (at + 1) % EVERYWHERE
    keys[0, at], slots[0, at] = key, slot


def words_of(values: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Occupancy of a cell: voxels whose centre is nearer than half a voxel."""
    near = values.reshape((CELL_SIDE,) * 3)[1:-1, 1:-1, 1:-1] < STEPS / HALF_WIDTH / 2.0
    bits = near.reshape(1024, 32).astype(np.uint64) << np.arange(32, dtype=np.uint64)
    words: NDArray[np.uint32] = bits.sum(axis=1).astype(np.uint32)
    return words


def mask_of(values: NDArray[np.uint8]) -> int:
    """Bits of the bricks that have a row of the band."""
    near = values.reshape((CELL_SIDE,) * 3) != BEYOND
    mask = 0
    for brick in np.ndindex(4, 4, 4):
        low = tuple(slice(8 * n, 8 * n + 10) for n in brick)
        if near[low].any():
            mask |= 1 << (16 * brick[0] + 4 * brick[1] + brick[2])
    return mask


# --- a tool and its hand ------------------------------------------------------------------------

SPRING = DeviceSpring(
    stiffness=1000.0, turn_stiffness=0.5, cap=20.0, turn_cap=1.0, damping=0.0, scale=1.0,
    radius=0.0, hold=0.02, fade=0.02,
)  # fmt: skip


def tool_of(points: ArrayLike, size: float, run: int = 64) -> Clusters:
    """A tool of points (N, 3) about their centre, without normals; size: of a voxel, m."""
    at = np.asarray(points, float).reshape(-1, 3)
    both = np.hstack([at, np.tile([0.0, 0.0, 1.0], (len(at), 1))])
    return Clusters(
        both, at.mean(axis=0), *spheres_of(both, size, run), run, np.ascontiguousarray(at.T),
        np.zeros((SCRATCH_ROWS, run)),
    )  # fmt: skip


class Hand:
    """A tool on its spring in a field; the test moves the hand."""

    def __init__(
        self,
        field: Field,
        points: ArrayLike,
        position: ArrayLike,
        quaternion: ArrayLike = UPRIGHT,
        **spring: float,
    ) -> None:
        self.field = field
        self.shell = tool = tool_of(points, field.place.size)
        reach = np.linalg.norm(self.shell.points[:, :3] - self.shell.center, axis=1).max()
        radius = max(float(reach), field.place.size)
        self.spring = SPRING._replace(radius=radius)._replace(**spring)
        self._periods = PeriodClock(DISTANCE)
        self._state = SessionState(
            self._periods.slots[0, ...], field.cells, 0, np.zeros((), REQUEST),
            Grid(1.0, (0, 0, 0), 6), tool,
        )  # fmt: skip
        self._state.slot["place"] = field.place
        self._periods.enter(self._state)
        self._state.set_spring(self.spring)
        self._state.rest_at(np.concatenate([position, quaternion]))
        self.servo, self.follower = self._state.servo, self._state.follower
        views = views_of(self.servo)
        self.tool, self.hand, self.sent = views.tool, views.hand, views.sent
        self.kept, self.near = self._state.kept, self._state.near_points
        self.bends, self.missed = self._state.bends, self._state.missed
        for array in (self.kept, self.near, self.bends):
            array.view(np.float64)[:] = np.nan

    def advance(self, dt: float = 1e-3) -> Floats:
        """Run one period; returns the force at the device (3,), a copy."""
        self._periods.step(dt, 0)
        force: Floats = self.sent.wrench[:3].copy()
        return force

    def move(self, position: ArrayLike, dt: float = 1e-3) -> Floats:
        """Put the hand somewhere and run one period."""
        self.hand.position[:] = position
        return self.advance(dt)

    def rest(self, periods: int) -> Floats:
        """Run periods with the hand at rest."""
        for _ in range(periods):
            self.advance()
        return self.advance()

    @property
    def placed(self) -> Floats:
        """Points of the tool (N, 3), world frame."""
        turn = rotation_of(self.tool.quaternion)[0]
        placed: Floats = self.shell.points[:, :3] @ turn.T + self.tool.position
        return placed

    @property
    def state(self) -> Floats:
        """Position and quaternion of the tool (7,)."""
        return pose_numbers(self.servo["tool"])


def punch(n_across: int, pitch: float) -> Floats:
    """A flat square of points about the origin, facing down (n_across^2, 3)."""
    across = (np.arange(n_across) - (n_across - 1) / 2.0) * pitch
    x, y = np.meshgrid(across, across, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(n_across**2)], axis=1)
