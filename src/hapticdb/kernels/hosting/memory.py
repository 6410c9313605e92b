"""Arrays at addresses: cells and tools of many sessions, which no kernel takes as arguments.

Sessions have tools and tables of different sizes. A record (`kernels.records.STATION`) has the
addresses and sizes of their arrays, and the arrays are made where they are used.
"""

import ctypes

import numpy as np
from numba import carray, config, types
from numba.core import cgutils
from numba.extending import intrinsic

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.field.lattice import CELL_VALUES
from hapticdb.kernels.resident.cells import (
    BUFFERS,
    CELL_WORDS,
    READER_STRIDE,
    SCRATCH_ROWS,
    Cells,
    Clusters,
    Place,
)

if config.DISABLE_JIT:

    def array_at(address, shape, dtype):
        """Array of that shape and type at an address."""
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        memory = (ctypes.c_char * size).from_address(int(address))
        return np.ndarray(shape, dtype, memory)

else:

    @intrinsic
    def _pointer(typing_context, address):  # noqa: ARG001 - numba's signature
        """Pointer of an address."""

        def generate(context, builder, signature, arguments):  # noqa: ARG001
            return builder.inttoptr(arguments[0], cgutils.voidptr_t)

        return types.voidptr(types.int64), generate

    @leaf
    def array_at(address, shape, dtype):
        """Array of that shape and type at an address."""
        return carray(_pointer(address), shape, dtype)


@leaf
def plane_cells(station):
    """Cells of a session without their distances."""
    n_slots, capacity = station.n_slots, station.capacity
    return Cells(
        array_at(station.control, (station.n_control,), np.int64),
        array_at(station.readers, (station.n_readers * READER_STRIDE,), np.int64),
        array_at(station.keys, (BUFFERS, capacity), np.int64),
        array_at(station.slots, (BUFFERS, capacity), np.int32),
        array_at(station.words, (n_slots, CELL_WORDS), np.uint32),
        array_at(station.masks, (n_slots,), np.uint64),
        array_at(station.used, (n_slots,), np.uint8),
        None,
        None,
    )


@leaf
def smooth_cells(station):
    """Cells of a session with their distances."""
    n_slots, capacity = station.n_slots, station.capacity
    return Cells(
        array_at(station.control, (station.n_control,), np.int64),
        array_at(station.readers, (station.n_readers * READER_STRIDE,), np.int64),
        array_at(station.keys, (BUFFERS, capacity), np.int64),
        array_at(station.slots, (BUFFERS, capacity), np.int32),
        array_at(station.words, (n_slots, CELL_WORDS), np.uint32),
        array_at(station.masks, (n_slots,), np.uint64),
        array_at(station.used, (n_slots,), np.uint8),
        array_at(station.payload, (n_slots, CELL_VALUES), np.uint8),
        array_at(station.near, (n_slots, CELL_WORDS), np.uint32),
    )


@leaf
def tool_of(station):
    """Tool of a session."""
    n_points = station.n_points
    return Clusters(
        array_at(station.points, (n_points, 6), np.float64),
        array_at(station.center, (3,), np.float64),
        array_at(station.spheres, (station.n_spheres, 4), np.float64),
        array_at(station.groups, (station.n_groups, 4), np.float64),
        station.run,
        array_at(station.columns, (3, n_points), np.float64),
        array_at(station.scratch, (SCRATCH_ROWS, station.run), np.float64),
    )


@leaf
def grid_of(station):
    """Grid of a session."""
    place = station.place
    return Place(place[0], place[1], place[2], place[3], place[4])
