"""Frames on the GPU: `resident.cell_frames.evaluate_frame` at many poses, or of millions of points.

A thread block evaluates one pose, or one of several shares of a large shell's points. Each thread
sums a strided subset of the points; a tree reduction adds the threads' sums, and the last block to
end adds those of the shares. The order of a sum depends on the number of points alone, so a frame
repeats bit for bit in any batch of poses.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import cuda, float64, int32

from hapticdb.kernels import force_law as laws
from hapticdb.kernels import rigid
from hapticdb.kernels.gpu.sources import on_gpu
from hapticdb.kernels.resident import cells

HITS, CONTACTS, UNKNOWNS, DEEPEST, RESULTS = 6, 7, 8, 9, 10
"""Rows of a block's sums behind the wrench, in the order of RESULT. Rows, because a reduction adds
them all; the results of B frames are RESULTS rows, too, for coalesced writes."""
WEIGHT = RESULTS
"""Row of a block's sums, after those of the results."""
SUMS = RESULTS + 1
NOT_RIGID = -1.0
"""Value in place of a frame's number of points in unknown cells: the pose is not rigid."""
THREADS, THREADS_OF_LARGE = 64, 256
"""Threads of a block. More: large shells finish sooner, and small ones leave threads idle."""
LARGE_FROM = 4096
"""Least number of points of a shell shared by several blocks."""
MOST_SHARES = 1056
"""Most blocks for a shell: 8 for each multiprocessor of the largest cards. More: less work for each
block, and more for the final sum."""

_moved, _turned, _transform_of, _is_rigid = map(
    on_gpu, (rigid.moved, rigid.turned, rigid.transform_of, rigid.is_rigid)
)
_slot_of, _cell_key, _column_of, _bit_in = map(
    on_gpu, (cells.slot_of, cells.cell_key, cells.column_of, cells.bit_in)
)
_accumulate, _average_into = on_gpu(laws.accumulate), on_gpu(laws.average_into)


def shares_of(n_points: int) -> tuple[int, int]:
    """Number of blocks for a shell of so many points, and threads of each."""
    if n_points < LARGE_FROM:
        return 1, THREADS
    return min(-(-n_points // THREADS_OF_LARGE), MOST_SHARES), THREADS_OF_LARGE


@on_gpu
def _slot_at(keys, slots, side, i, j, k):
    """Slot of the cell of voxel (i, j, k): by an array of all cells, or by the hash directory."""
    if keys.shape[1] == 1:
        # dense array of all cells where it fits: one load instead of a probe
        n = (np.int64(side) + 31) >> 5
        return slots[0, ((i >> 5) * n + (j >> 5)) * n + (k >> 5)]
    return np.int32(_slot_of(keys, slots, 0, _cell_key(i, j, k)))


@on_gpu
def _transform_at(poses, n):
    """Transform of pose n of an array (B, 4, 4)."""
    return _transform_of(poses[n])


@on_gpu
def _transform_itself(pose, n):  # noqa: ARG001 - as `_transform_at`
    """Identity: the transform of a single pose is the argument itself."""
    return pose


@functools.cache
def _adding_under(law_type: type) -> Callable[..., Any]:
    """Device function: sums of every `step`-th point of a shell under that type of law."""
    leaves = laws.LEAVES[law_type]
    respond, reach = on_gpu(leaves.respond), on_gpu(leaves.reach)
    sample_at, share_at = on_gpu(leaves.sample_slot), on_gpu(leaves.share_slot)

    def add_points(
        law, grid, shell, transform, first, step, keys, slots, words, gate, payload, sums
    ):  # fmt: skip
        total = shell.shape[1] - 1
        center = _moved(transform, shell[0, total], shell[1, total], shell[2, total])
        for row in range(SUMS):
            sums[row] = 0.0
        size, side = grid.size, grid.side
        for n in range(first, total, step):
            px, py, pz = _moved(transform, shell[0, n], shell[1, n], shell[2, n])
            x, y, z = (px - grid.x) / size, (py - grid.y) / size, (pz - grid.z) / size
            if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
                continue
            i, j, k = np.int64(x), np.int64(y), np.int64(z)
            # gates in the order of cost: directory, one bit, then the distance
            slot = _slot_at(keys, slots, side, i, j, k)
            if slot <= cells.EMPTY_SLOT:
                sums[UNKNOWNS] += slot < 0
                continue
            column = _column_of(i, j)
            if not _bit_in(gate[slot, column], k):
                continue
            is_hit = _bit_in(words[slot, column], k) != 0
            sample = sample_at(law, payload, slot, x, y, z)
            if not (is_hit or sample <= reach(law)):
                continue
            nx, ny, nz = _turned(transform, shell[3, n], shell[4, n], shell[5, n])
            cx = grid.x + size * (float(i) + 0.5)
            cy = grid.y + size * (float(j) + 0.5)
            cz = grid.z + size * (float(k) + 0.5)
            point = px, py, pz, nx, ny, nz, cx, cy, cz
            depth, counted = respond(law, is_hit, sample, *point, size)
            share = share_at(law, payload, slot, x, y, z, nx, ny, nz, sample)
            depth *= share
            sums[WEIGHT] += counted * share
            sums[HITS] += is_hit
            if depth > 0.0:
                sums[CONTACTS] += 1.0
                sums[DEEPEST] = max(sums[DEEPEST], depth)
                wrench = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
                sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = _accumulate(
                    wrench, point, center, depth, law.stiffness
                )

    return on_gpu(add_points)


@cuda.jit(device=True)
def _add_up(both, t):
    """Tree reduction of both (SUMS, threads) into column 0: sums, and the maximum of DEEPEST."""
    # no atomic additions: the order is fixed, so are the sums from run to run
    cuda.syncthreads()
    half = both.shape[1] // 2
    while half > 0:
        if t < half:
            for row in range(SUMS):
                if row == DEEPEST:
                    both[row, t] = max(both[row, t], both[row, t + half])
                else:
                    both[row, t] += both[row, t + half]
        cuda.syncthreads()
        half //= 2


@cuda.jit(device=True)
def _write(sums, n, total, out):
    """Write frame n of `total` from its sums (SUMS,), in the layout of `frames_under`."""
    _average_into(sums, sums[WEIGHT], sums)
    for axis in range(3):
        out[3 * n + axis] = sums[axis]
        out[3 * total + 3 * n + axis] = sums[3 + axis]
    for row in range(HITS, RESULTS):
        out[row * total + n] = sums[row]


@functools.cache
def frames_under(law_type: type, threads: int, *, single: bool) -> Any:  # noqa: ANN401 - numba's kernels are untyped
    """CUDA kernel of frames under that type of law, for blocks of so many threads (a power of two).

    Its arguments: law, place; shell (6, N + 1): points and normals, last the centre; poses
    (B, 4, 4), or if `single` the 12 numbers of one rigid transform, unchecked; keys
    (1, capacity), slots (1, capacity), words (S, 1024), payload (S, 34^3) as in
    `resident.cells.Cells`, or keys (1, 1) and the slots of all cells of the grid; gate (S, 1024)
    uint32: voxels with possible contacts; sums (B, shares, SUMS): scratch of the shares; ended (B,)
    int32: 0 before and after; out (RESULTS x B,): forces (B, 3), torques (B, 3), and B each of
    hits, contacts, points in unknown cells or `NOT_RIGID`, and deepest.
    """
    add_points = _adding_under(law_type)
    transform_at = _transform_itself if single else _transform_at

    @cuda.jit
    def frames(law, grid, shell, poses, keys, slots, words, gate, payload, sums, ended, out):
        both = cuda.shared.array((SUMS, threads), float64)
        n_ended = cuda.shared.array(1, int32)
        t, total, shares = cuda.threadIdx.x, out.shape[0] // RESULTS, sums.shape[1]
        for at in range(cuda.blockIdx.x, total * shares, cuda.gridDim.x):
            n, block = at // shares, at % shares
            add_points(
                law, grid, shell, transform_at(poses, n), block * threads + t, shares * threads,
                keys, slots, words, gate, payload, both[:, t],
            )  # fmt: skip
            _add_up(both, t)
            if shares > 1:
                for row in range(t, SUMS, threads):
                    sums[n, block, row] = both[row, 0]
                # the shares are in global memory before the counter says so
                cuda.threadfence()
                cuda.syncthreads()
                if t == 0:
                    n_ended[0] = cuda.atomic.add(ended, n, 1)
                cuda.syncthreads()
                # the last block to finish adds all shares: no second launch
                if n_ended[0] < shares - 1:
                    continue
                for row in range(SUMS):
                    both[row, t] = 0.0
                    for one in range(t, shares, threads):
                        if row == DEEPEST:
                            both[row, t] = max(both[row, t], sums[n, one, row])
                        else:
                            both[row, t] += sums[n, one, row]
                _add_up(both, t)
            if t == 0:
                ended[n] = 0  # ready for the next launch
                _write(both[:, 0], n, total, out)
                if not single and not _is_rigid(poses[n]):
                    out[UNKNOWNS * total + n] = NOT_RIGID
            cuda.syncthreads()

    return frames
