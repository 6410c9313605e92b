"""Proximity queries of the coupling on the GPU: `hand.near_points.look` for tools of any size.

A query is two launches, replayed by a CUDA graph with fixed arguments, so its parameters are read
from memory (`Sight.asked`). In the first launch a thread tests a run of points: is it due, and is
its bounding sphere free? In the second a block processes a due run without a free sphere, a thread
each point. Only near points are copied to the host, in any order, each with its number; the `due`
values of points (see POINT) stay on the GPU. A query that ends early restores them beyond its last
point, so that a tool takes the same path as on the CPU.
"""

import functools
from collections import namedtuple
from typing import Any

import numpy as np
from numba import cuda, float64, int64

from hapticdb.kernels import rigid
from hapticdb.kernels.field.law import ONSET
from hapticdb.kernels.gpu.nearest import agree
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
"""Rows of `Sight.near`: the fields of the record NEAR from `u` on, and from CURVATURE on those of
BENDS, 0 where the surface is not hollow."""
ROOM_FOR_MISSED = 128
"""Most unknown cells reported by a query, a power of two. Larger: fewer rounds of fetching."""
DUE_RUNS, NEARS, UNKNOWNS, LEAST, FOUND = 0, 1, 2, 3, 4
"""Indices in `Sight.found`: runs of the second launch; near points; points in unknown cells; least
path length at which a run is due, voxels. Last, the number of these."""

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


Sight = namedtuple(  # noqa: PYI024 - all fields are arrays of the GPU
    "Sight",
    "points spheres due run_due due_before run_due_before epochs seen due_runs asked used missed "
    "found points_near near",
)
"""Device view of a tool of N points in R runs, and the results of a query.

points (3, N + 1): m, last the centre; spheres (R, 4), or none for a small tool. due (N,),
run_due (R,): as in the record POINT; due_before, run_due_before: the values overwritten by the
last query; epochs (R,) int64: epoch in which the run's `due` was written, valid only in the
current one; seen (R,) int64: number of the last query of the run; due_runs (R,) int64: runs of
the second launch. `asked` (1,): a query's QUERY. used (S,) uint8: slots read. missed
(ROOM_FOR_MISSED,) int64: keys of unknown cells, in no order, -1 for none. `found` (FOUND,).
points_near (M,) int64 and near (NEAR_NUMBERS, M): the near points, at most M, in host memory;
values of neighbouring points are adjacent, for coalesced writes.
"""


@cuda.jit
def list_due_runs(place, seen, sight):
    """First launch: list the due runs without a free sphere. seen : `resident.cells.Seen`."""
    least, asked = NEVER, sight.asked[0]
    transform = _transform_of(asked.pose)
    for run in range(cuda.grid(1), sight.run_due.shape[0], cuda.gridsize(1)):
        before = -NEVER if asked.is_anew else sight.run_due[run]
        if asked.travelled < before:
            least = min(least, before)
            continue
        sight.seen[run], sight.run_due_before[run] = asked.number, before
        if asked.is_large and (before == -NEVER or before >= asked.travelled - asked.way):
            rest = _rest_of_sphere(seen, sight.spheres, run, transform, place)
            if rest > 0.0:
                sight.run_due[run] = asked.travelled + rest
                least = min(least, asked.travelled + rest)
                continue
        sight.due_runs[np.int64(cuda.atomic.add(sight.found, DUE_RUNS, 1.0))] = run
    cuda.atomic.min(sight.found, LEAST, least)


@cuda.jit(device=True)
def _miss(missed, key):
    """Add an unknown cell to the hash set `missed`, if absent and there is room."""
    at = _spread(key, ROOM_FOR_MISSED)
    for _ in range(ROOM_FOR_MISSED):
        before = cuda.atomic.cas(missed, at, -1, key)
        if before in (-1, key):
            return
        at = (at + 1) & (ROOM_FOR_MISSED - 1)


@cuda.jit(device=True)
def _write_near(payload, slot, mask, inside, lever, looked, is_bent, near, at):
    """Write column `at` of `Sight.near`."""
    near[0, at], near[1, at], near[CURVATURE, at] = looked[0], looked[4], 0.0
    both = _along_and_about(lever, looked[1], looked[2], looked[3])
    for row in range(6):
        near[2 + row, at] = both[row]
    if is_bent and _may_be_hollow(mask, inside, looked[0]):
        c, d, v, w = _bends_at(payload, slot, inside, lever, looked)
        near[CURVATURE, at], near[CURVATURE + 1, at] = c, d
        for row in range(3):
            near[10 + row, at], near[13 + row, at] = v[row], w[row]
            near[16 + row, at], near[19 + row, at] = v[3 + row], w[3 + row]


@cuda.jit(device=True)
def _look_at_point(n, place, asked, transform, seen, payload, sight):
    """Query due point n -> path length at which it is due again; see `near_points.look`."""
    points, center = sight.points, sight.points.shape[1] - 1
    px, py, pz = _moved(transform, points[0, n], points[1, n], points[2, n])
    inside = _clamped_into(place, px, py, pz)
    key = _cell_key(np.int64(inside[0]), np.int64(inside[1]), np.int64(inside[2]))
    slot, mask = _slot_of(seen.keys, seen.slots, seen.which, key), np.uint64(0)
    if slot < 0:
        cuda.atomic.add(sight.found, UNKNOWNS, 1.0)
        _miss(sight.missed, key)
        return -NEVER
    if slot > EMPTY_SLOT:
        seen.used[slot] = 1
        mask = seen.masks[slot]
    if n & (asked.merged - 1):  # merged into another point's contact
        bound = _bound_at(payload, slot, mask, inside)
        if bound >= LEAST_BOUND:
            return asked.travelled + bound - FAR
    looked = _distance_at(payload, slot, mask, inside)
    u, bound = looked[0], looked[4]
    if u < ONSET + MARGIN or bound < LEAST_BOUND:
        at = np.int64(cuda.atomic.add(sight.found, NEARS, 1.0))
        if at < sight.points_near.shape[0]:
            cx, cy, cz = _moved(transform, points[0, center], points[1, center], points[2, center])
            sight.points_near[at] = n
            lever = px - cx, py - cy, pz - cz
            _write_near(payload, slot, mask, inside, lever, looked, asked.is_bent, sight.near, at)
    return asked.travelled + bound - FAR


@functools.cache
def look_at_runs(threads: int) -> Any:  # noqa: ANN401 - numba's kernels are untyped
    """CUDA kernel of the second launch, for blocks of so many threads (a power of two).

    Its arguments: those of `list_due_runs`, and payload (S, 34^3).
    """

    @cuda.jit
    def look(place, seen, payload, sight):
        best = cuda.shared.array(threads, float64)
        nobody = cuda.shared.array(threads, int64)
        t, n_points, asked = cuda.threadIdx.x, sight.due.shape[0], sight.asked[0]
        transform = _transform_of(asked.pose)
        for at in range(cuda.blockIdx.x, np.int64(sight.found[DUE_RUNS]), cuda.gridDim.x):
            run, least = sight.due_runs[at], NEVER
            is_known, start = sight.epochs[run] == asked.epoch, run * asked.run
            for n in range(start + t, min(start + asked.run, n_points), threads):
                due = sight.due[n] if is_known else -NEVER
                sight.due_before[n] = due
                if asked.travelled >= due:
                    due = _look_at_point(n, place, asked, transform, seen, payload, sight)
                    sight.due[n] = due
                least = min(least, due)
            best[t], nobody[t] = least, 0
            agree(best, nobody, t)
            if t == 0:
                sight.epochs[run], sight.run_due[run] = asked.epoch, best[0]
                cuda.atomic.min(sight.found, LEAST, best[0])
            cuda.syncthreads()

    return look


@cuda.jit
def put_back(sight):
    """Restore the due values of points beyond `last`, and those of runs from its own on."""
    first, step, asked = cuda.grid(1), cuda.gridsize(1), sight.asked[0]
    last = asked.last
    for run in range(max(last, 0) // asked.run + first, sight.seen.shape[0], step):
        if sight.seen[run] == asked.number:
            sight.run_due[run] = sight.run_due_before[run]
    for at in range(first, asked.n_due, step):
        start = sight.due_runs[at] * asked.run
        for n in range(max(start, last + 1), min(start + asked.run, sight.due.shape[0])):
            sight.due[n] = sight.due_before[n]
