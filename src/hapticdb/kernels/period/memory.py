"""Arrays at addresses: cells and tools of a variable number of sessions, in one kernel.

Sessions have tools and tables of different sizes. A slot (`kernels.records.session.SLOT`) has the
addresses and sizes of their arrays, and kernels make array views from them.
"""

import ctypes
from typing import NamedTuple

import numpy as np
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array
from numpy.typing import NDArray

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.field.lattice import CELL_VALUES
from hapticdb.kernels.hand.device_spring import DeviceSpring
from hapticdb.kernels.records.cells import BUFFERS, CONTROL, MISSED, READER
from hapticdb.kernels.records.hand import BENDS, NEAR, POINT, RESULT
from hapticdb.kernels.resident.cells import (
    CELL_WORDS,
    SCRATCH_ROWS,
    CellGrid,
    Cells,
    Clusters,
)

if config.DISABLE_JIT:

    def array_at(address, shape, dtype):
        """Array of that shape and type at an address."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        memory = (ctypes.c_char * size).from_address(int(address))
        return np.ndarray(shape, dtype, memory)

else:

    @intrinsic
    def array_at(typing_context, address, shape, dtype):  # noqa: ARG001 - numba's signature
        """Array of that shape and type at an address, without reference counts."""
        kind = types.Array(dtype.dtype, len(shape), "C")

        def generate(context, builder, signature, arguments):  # noqa: ARG001
            made = context.make_array(kind)(context, builder)
            lengths = cgutils.unpack_tuple(builder, arguments[1])
            size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
            # C order: each stride is the next one times that axis's length
            strides = [context.get_constant(types.intp, size)]
            for length in lengths[:0:-1]:
                strides.insert(0, builder.mul(strides[0], length))
            # no `meminfo`: a view is not counted, so the loop has no atomic operations for it
            populate_array(
                made, builder.inttoptr(arguments[0], made.data.type), lengths,
                strides[: len(lengths)], strides[-1], None,
            )  # fmt: skip
            return made._getvalue()  # noqa: SLF001

        return kind(types.int64, shape, dtype), generate


@leaf
def _cells_with(slot, payload, near):
    """Cells of a session; payload, near : arrays of distances, or None."""
    at, n_slots, capacity = slot.cells, slot.n_slots, slot.capacity
    return Cells(
        array_at(at.control, (), CONTROL),
        array_at(at.readers, (slot.n_readers,), READER),
        array_at(at.keys, (BUFFERS, capacity), np.int64),
        array_at(at.slots, (BUFFERS, capacity), np.int32),
        array_at(at.words, (n_slots, CELL_WORDS), np.uint32),
        array_at(at.masks, (n_slots,), np.uint64),
        array_at(at.used, (n_slots,), np.uint8),
        payload,
        near,
    )


@leaf
def voxels_of(slot):
    """Cells of a session, without distances."""
    return _cells_with(slot, None, None)


@leaf
def cells_of(slot):
    """Cells of a session, with distances."""
    payload = array_at(slot.cells.payload, (slot.n_slots, CELL_VALUES), np.uint8)
    near = array_at(slot.cells.near, (slot.n_slots, CELL_WORDS), np.uint32)
    return _cells_with(slot, payload, near)


@leaf
def tool_of(slot):
    """Tool of a session."""
    at, n_points = slot.arrays, slot.n_points
    return Clusters(
        array_at(at.points, (n_points, 6), np.float64),
        array_at(at.center, (3,), np.float64),
        array_at(at.spheres, (slot.n_spheres, 4), np.float64),
        array_at(at.groups, (slot.n_groups, 4), np.float64),
        slot.run,
        array_at(at.columns, (3, n_points), np.float64),
        array_at(at.scratch, (SCRATCH_ROWS, slot.run), np.float64),
    )


class Memory(NamedTuple):
    """Arrays shared by the parts of a period.

    pose (4, 4): of the tool; `felt`, missed (1,) of RESULT and MISSED: the law's frame, as from
    `cell_frames.evaluate_frame`; `met`, `kept`, near, bends: of the tool's points, as in
    `near_points.ProximityQuery`.
    """

    pose: NDArray[np.float64]
    felt: NDArray[np.void]
    missed: NDArray[np.void]
    met: NDArray[np.int64]
    kept: NDArray[np.void]
    near: NDArray[np.void]
    bends: NDArray[np.void]


@leaf
def memory_of(slot):
    """Arrays shared by the parts of a session's period."""
    at, n_points = slot.arrays, slot.n_points
    return Memory(
        array_at(at.pose, (4, 4), np.float64),
        array_at(at.felt, (1,), RESULT),
        array_at(at.missed, (1,), MISSED),
        array_at(at.met, (n_points,), np.int64),
        array_at(at.kept, (n_points,), POINT),
        array_at(at.near_points, (2, n_points), NEAR),
        array_at(at.bends, (2, n_points), BENDS),
    )


@leaf
def grid_of(slot):
    """Grid of a session."""
    place = slot.place
    return CellGrid(place[0], place[1], place[2], place[3], place[4])


@leaf
def spring_of(slot):
    """Spring of a session, as latched for the period."""
    n = slot.springs[slot.used_spring]
    return DeviceSpring(n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8])
