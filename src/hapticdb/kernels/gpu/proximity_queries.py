"""Proximity queries of the coupling on the GPU: `hand.near_points` for tools of any size.

A query is two launches, replayed by a CUDA graph with fixed arguments, so its parameters are read
from memory (`DeviceView.query`). In the first launch a thread tests a run of points: is it due, and
is its bounding sphere free? In the second a block processes a due run without a free sphere, a
thread each point. Only near points are copied to the host, in any order, each with its number; the
`due` values of points (see POINT) stay on the GPU. A query that ends early restores them beyond its
last point, so that a tool takes the same path as on the CPU.
"""

import functools
from collections import namedtuple
from typing import Any

import numpy as np
from numba import cuda, float64, int64

from hapticdb.kernels import rigid
from hapticdb.kernels.field.distance_law import ONSET
from hapticdb.kernels.gpu.gpu_nearest import agree
from hapticdb.kernels.gpu.sources import on_gpu
from hapticdb.kernels.hand import near_points
from hapticdb.kernels.hand.near_points import FAR, LEAST_BOUND, MARGIN, NEVER
from hapticdb.kernels.resident import cells
from hapticdb.kernels.resident.cells import EMPTY_SLOT

THREADS_OF_RUNS, THREADS = 128, 64
"""Threads of a block in the first and the second launch."""
MOST_BLOCKS = 1 << 13
"""Most blocks of a launch; with more runs, a block processes several."""
NEAR_NUMBERS, CURVATURE = 22, 8
"""Rows of `DeviceView.near`: the fields of the record NEAR from `u` on, and from CURVATURE on those
of BENDS, 0 where the surface is not hollow."""
ROOM_FOR_MISSED = 128
"""Most unknown cells reported by a query, a power of two. Larger: fewer rounds of fetching."""
DUE_RUNS, NEARS, UNKNOWNS, LEAST, FOUND = 0, 1, 2, 3, 4
"""Indices in `DeviceView.found`: runs of the second launch; near points; points in unknown cells;
least path length at which a run is due, voxels. Last, the number of these."""

_moved, _transform_of = map(on_gpu, (rigid.moved, rigid.transform_of))
_slot_of, _cell_key, _spread = map(on_gpu, (cells.slot_of, cells.cell_key, cells.spread_key))
_clamped_into, _bound_at, _distance_at, _rest_of_sphere = map(
    on_gpu,
    (
        near_points.clamped_into,
        near_points.bound_at,
        near_points.distance_at,
        near_points.rest_of_sphere,
    ),
)
_along_and_about, _bends_at, _may_be_hollow = map(
    on_gpu, (near_points.along_and_about, near_points.bends_at, near_points.may_be_hollow)
)


DeviceView = namedtuple(  # noqa: PYI024 - all fields are arrays of the GPU
    "DeviceView",
    "points spheres due run_due due_before run_due_before epochs seen due_runs query used missed "
    "found points_near near",
)
"""Device view of a tool of N points in R runs, and the results of a query.

points (3, N + 1): m, last the centre; spheres (R, 4), or none for a small tool. due (N,),
run_due (R,): as in the record POINT; due_before, run_due_before: the values overwritten by the
last query; epochs (R,) int64: epoch in which the run's `due` was written, valid only in the
current one; seen (R,) int64: number of the last query of the run; due_runs (R,) int64: runs of
the second launch. `query` (1,): a query's QUERY. used (S,) uint8: slots read. missed
(ROOM_FOR_MISSED,) int64: keys of unknown cells, in no order, -1 for none. `found` (FOUND,).
points_near (M,) int64 and near (NEAR_NUMBERS, M): the near points, at most M, in host memory;
values of neighbouring points are adjacent, for coalesced writes.
"""


@cuda.jit
def list_due_runs(grid, seen, view):
    """First launch: list the due runs without a free sphere. seen : `resident.cells.Seen`."""
    least, query = NEVER, view.query[0]
    transform = _transform_of(query.pose)
    for run in range(cuda.grid(1), view.run_due.shape[0], cuda.gridsize(1)):
        # the old value is kept: `put_back` undoes the query beyond a refusal
        before = -NEVER if query.is_anew else view.run_due[run]
        if query.travelled < before:
            least = min(least, before)
            continue
        view.seen[run], view.run_due_before[run] = query.number, before
        if query.is_large and (before == -NEVER or before >= query.travelled - query.way):
            rest = _rest_of_sphere(seen, view.spheres, run, transform, grid)
            if rest > 0.0:
                view.run_due[run] = query.travelled + rest
                least = min(least, query.travelled + rest)
                continue
        view.due_runs[np.int64(cuda.atomic.add(view.found, DUE_RUNS, 1.0))] = run
    # once a thread: the local minimum spares an atomic operation for each run
    cuda.atomic.min(view.found, LEAST, least)


@cuda.jit(device=True)
def _miss(missed, key):
    """Add an unknown cell to the hash set `missed`, if absent and there is room."""
    at = _spread(key, ROOM_FOR_MISSED)
    for _ in range(ROOM_FOR_MISSED):
        # a free place is claimed atomically: two threads may miss the same cell
        before = cuda.atomic.cas(missed, at, -1, key)
        if before in (-1, key):
            return
        at = (at + 1) & (ROOM_FOR_MISSED - 1)


@cuda.jit(device=True)
def _write_near(payload, slot, mask, inside, lever, sample, is_bent, near, at):
    """Write column `at` of `DeviceView.near`."""
    near[0, at], near[1, at], near[CURVATURE, at] = sample[0], sample[4], 0.0
    both = _along_and_about(lever, sample[1], sample[2], sample[3])
    for row in range(6):
        near[2 + row, at] = both[row]
    if is_bent and _may_be_hollow(mask, inside, sample[0]):
        c, d, v, w = _bends_at(payload, slot, inside, lever, sample)
        near[CURVATURE, at], near[CURVATURE + 1, at] = c, d
        for row in range(3):
            near[10 + row, at], near[13 + row, at] = v[row], w[row]
            near[16 + row, at], near[19 + row, at] = v[3 + row], w[3 + row]


@cuda.jit(device=True)
def _query_point(n, grid, query, transform, seen, payload, view):
    """Query due point n -> path length at which it is due again; see `near_points`."""
    points, center = view.points, view.points.shape[1] - 1
    px, py, pz = _moved(transform, points[0, n], points[1, n], points[2, n])
    inside = _clamped_into(grid, px, py, pz)
    key = _cell_key(np.int64(inside[0]), np.int64(inside[1]), np.int64(inside[2]))
    slot, mask = _slot_of(seen.keys, seen.slots, seen.which, key), np.uint64(0)
    if slot < 0:
        cuda.atomic.add(view.found, UNKNOWNS, 1.0)
        _miss(view.missed, key)
        return -NEVER
    if slot > EMPTY_SLOT:
        seen.used[slot] = 1
        mask = seen.masks[slot]
    if n & (query.merged - 1):  # merged into another point's contact
        bound = _bound_at(payload, slot, mask, inside)
        if bound >= LEAST_BOUND:
            return query.travelled + bound - FAR
    sample = _distance_at(payload, slot, mask, inside)
    u, bound = sample[0], sample[4]
    if u < ONSET + MARGIN or bound < LEAST_BOUND:
        # counted even without room: the host sees how many there were
        at = np.int64(cuda.atomic.add(view.found, NEARS, 1.0))
        if at < view.points_near.shape[0]:
            cx, cy, cz = _moved(transform, points[0, center], points[1, center], points[2, center])
            view.points_near[at] = n
            lever = px - cx, py - cy, pz - cz
            _write_near(payload, slot, mask, inside, lever, sample, query.is_bent, view.near, at)
    return query.travelled + bound - FAR


@functools.cache
def query_runs(threads: int) -> Any:  # noqa: ANN401 - numba's kernels are untyped
    """CUDA kernel of the second launch, for blocks of so many threads (a power of two).

    Its arguments: those of `list_due_runs`, and payload (S, 34^3).
    """

    @cuda.jit
    def run_queries(grid, seen, payload, view):
        best = cuda.shared.array(threads, float64)
        nobody = cuda.shared.array(threads, int64)
        t, n_points, query = cuda.threadIdx.x, view.due.shape[0], view.query[0]
        transform = _transform_of(query.pose)
        for at in range(cuda.blockIdx.x, np.int64(view.found[DUE_RUNS]), cuda.gridDim.x):
            run, least = view.due_runs[at], NEVER
            # a new epoch voids all `due` at once, without a write to each point
            is_known, start = view.epochs[run] == query.epoch, run * query.run
            for n in range(start + t, min(start + query.run, n_points), threads):
                due = view.due[n] if is_known else -NEVER
                # also of points that are not due: `put_back` restores the run as a whole
                view.due_before[n] = due
                if query.travelled >= due:
                    due = _query_point(n, grid, query, transform, seen, payload, view)
                    view.due[n] = due
                least = min(least, due)
            best[t], nobody[t] = least, 0
            # block-wide: the loop's bounds are the same for all threads, so each meets the barrier
            agree(best, nobody, t)
            if t == 0:
                view.epochs[run], view.run_due[run] = query.epoch, best[0]
                cuda.atomic.min(view.found, LEAST, best[0])
            cuda.syncthreads()

    return run_queries


@cuda.jit
def put_back(view):
    """Restore the due values of points beyond `last`, and those of runs from its own on."""
    first, step, query = cuda.grid(1), cuda.gridsize(1), view.query[0]
    last = query.last
    for run in range(max(last, 0) // query.run + first, view.seen.shape[0], step):
        if view.seen[run] == query.number:
            view.run_due[run] = view.run_due_before[run]
    for at in range(first, query.n_due, step):
        start = view.due_runs[at] * query.run
        for n in range(max(start, last + 1), min(start + query.run, view.due.shape[0])):
            view.due[n] = view.due_before[n]
