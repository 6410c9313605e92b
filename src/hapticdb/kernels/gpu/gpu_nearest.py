"""Distances on the GPU: the occupied voxel nearest to a shell, at many poses.

A thread block evaluates a pose, one point a thread. Each thread searches up to the least distance
so far; a reduction then renews that bound for the next points.
"""

import functools
from typing import Any

import numpy as np
from numba import cuda, float64, int64

from hapticdb.kernels import rigid
from hapticdb.kernels.gpu.sources import on_gpu
from hapticdb.kernels.resident import cells
from hapticdb.kernels.resident import nearest_voxels as searches

THREADS = 64
"""Threads of a block. More: more parallel searches, and a bound renewed less often."""
NO_POINT, UNDECIDED = -1, -2
"""Values in place of a pose's nearest point: nothing within reach; an unknown cell within reach."""

_transform_of, _in_voxels = on_gpu(rigid.transform_of), on_gpu(cells.in_voxels)
_nearest_voxel = on_gpu(searches.nearest_voxel)


@cuda.jit(device=True)
def agree(squares, points, t):
    """Tree reduction to element 0: least of squares (threads,), and the lowest of its points."""
    cuda.syncthreads()
    half = squares.shape[0] // 2
    while half > 0:
        if t < half:
            other = squares[t + half]
            if other < squares[t] or (other == squares[t] and points[t + half] < points[t]):
                squares[t], points[t] = other, points[t + half]
        cuda.syncthreads()
        half //= 2


@functools.cache
def search_kernel(threads: int) -> Any:  # noqa: ANN401 - numba's kernels are untyped
    """CUDA kernel of the search, for blocks of so many threads (a power of two).

    Its arguments: place; shell (6, N + 1), as in `gpu_frames`; poses (B, 4, 4), rigid; seen, of
    `resident.cells.Seen`; reach, voxels; outputs: squares (B,) of distances, voxels, and points
    (B,).
    """

    @cuda.jit
    def search(grid, shell, poses, seen, reach, squares, points):
        best = cuda.shared.array(threads, float64)
        nearest = cuda.shared.array(threads, int64)
        t, total = cuda.threadIdx.x, shell.shape[1] - 1
        for n in range(cuda.blockIdx.x, poses.shape[0], cuda.gridDim.x):
            transform = _transform_of(poses[n])
            square, point = reach * reach, np.int64(total)  # no point yet
            for first in range(0, total, threads):
                at = first + t
                best[t], nearest[t] = square, point
                if at < total and point >= 0:
                    x, y, z = _in_voxels(transform, grid, shell[0, at], shell[1, at], shell[2, at])
                    found, voxel = _nearest_voxel(seen, x, y, z, square, np.int64(-1), grid.side)
                    if voxel == UNDECIDED:
                        best[t], nearest[t] = -1.0, np.int64(UNDECIDED)
                    elif voxel >= 0:
                        best[t], nearest[t] = found, np.int64(at)
                # also by threads without a point: the barriers inside need the whole block
                agree(best, nearest, t)
                # every thread reads the result before the next point overwrites it
                square, point = best[0], nearest[0]
                cuda.syncthreads()
            if t == 0:
                squares[n] = square
                points[n] = point if point < total else NO_POINT

    return search
