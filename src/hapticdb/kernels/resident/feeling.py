"""Frames over resident cells: what a placed shell feels, without a database."""

from typing import Any

import numpy as np

from hapticdb.kernels._jit import FLOAT, FLOATS2, INT, chosen_by_type, entry, leaf
from hapticdb.kernels.field.law import DistanceFieldLaw
from hapticdb.kernels.law import (
    TangentPlaneLaw,
    accumulate,
    average_into,
    felt_within,
    reach,
    respond,
    sample_slot,
    share_slot,
)
from hapticdb.kernels.query.contact import center_of
from hapticdb.kernels.resident.cells import (
    CONTACTS,
    DEEPEST,
    HITS,
    LISTED,
    UNKNOWN,
    UNKNOWNS,
    bit_in,
    brick_bit,
    cell_key,
    column_of,
    enter_cell,
)
from hapticdb.kernels.resident.distance_frames import felt_by_distance
from hapticdb.kernels.resident.plane_frames import felt_by_plane
from hapticdb.kernels.resident.runs import free_runs, place_run
from hapticdb.kernels.rigid import moved, transform_of, turned


@leaf
def _respond_at(law, is_hit, sample, transform, px, py, pz, nx, ny, nz, ox, oy, oz, size):
    """Depth, weight and turned normal of a placed point p; n is its normal in the tool's frame."""
    nx, ny, nz = turned(transform, nx, ny, nz)
    cx, cy, cz = center_of(px, ox, size), center_of(py, oy, size), center_of(pz, oz, size)
    depth, weight = respond(law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size)
    return depth, weight, nx, ny, nz


@leaf
def felt(cells, which, shell, pose, place, law, met, missed, out):
    """One frame: hits of a placed shell and the wrench of the points felt, into out (RESULTS,).

    met (N,) takes the indices of the hits; missed (1 + MOST_MISSED,) takes the number and the keys
    of the unknown cells that hold points. A point in an unknown cell is neither a hit nor a miss.
    Arithmetic and order of the sums are those of `contact.locate` and `refining.refine`.
    """
    _, _, keys, slots, words, masks, used, payload, _ = cells
    points, _, spheres, groups, run, columns, scratch = shell
    transform = transform_of(pose)
    ox, oy, oz, size, side = place.x, place.y, place.z, place.size, place.side
    mx, my, mz = moved(transform, shell.center[0], shell.center[1], shell.center[2])
    fx = fy = fz = tx = ty = tz = weight = deepest = 0.0
    n_hits = n_contacts = n_unknown = n_missed = cluster = start = 0
    last_key, slot, mask = np.int64(-1), np.int64(UNKNOWN), np.uint64(0)
    while start < points.shape[0]:
        n_free = free_runs(
            keys, slots, words, masks, used, which, spheres, groups, cluster, transform, place,
            felt_within(law),
        )  # fmt: skip
        if n_free > 0:
            cluster += n_free
            start += n_free * run
            continue
        n_run = min(run, points.shape[0] - start)
        place_run(columns, start, n_run, transform, place, scratch)
        for at in range(n_run):
            x, y, z = scratch[3, at], scratch[4, at], scratch[5, at]
            if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
                continue
            i, j, k = np.int64(x), np.int64(y), np.int64(z)
            key = cell_key(i, j, k)
            if key != last_key:
                last_key = key
                slot, mask, n_missed = enter_cell(
                    keys, slots, masks, used, which, key, missed, n_missed
                )
            # bricks first: most of space is free, and the mask is in a register
            if not (mask >> brick_bit(i, j, k)) & np.uint64(1):
                if slot < 0:
                    n_unknown += 1
                continue
            is_hit = bit_in(words[slot, column_of(i, j)], k) != 0
            sample = sample_slot(law, payload, slot, x, y, z)
            if not (is_hit or sample <= reach(law)):
                continue
            n = start + at
            px, py, pz = scratch[0, at], scratch[1, at], scratch[2, at]
            depth, counted, nx, ny, nz = _respond_at(
                law, is_hit, sample, transform, px, py, pz, points[n, 3], points[n, 4],
                points[n, 5], ox, oy, oz, size,
            )  # fmt: skip
            share = share_slot(law, payload, slot, x, y, z, nx, ny, nz, sample)
            depth *= share
            weight += counted * share
            if is_hit:
                met[n_hits] = n
                n_hits += 1
            if depth > 0.0:
                n_contacts += 1
                deepest = max(deepest, depth)
                fx, fy, fz, tx, ty, tz = accumulate(
                    fx, fy, fz, tx, ty, tz, px, py, pz, nx, ny, nz, mx, my, mz, depth, law.stiffness
                )
        cluster += 1
        start += n_run
    average_into(out, weight, fx, fy, fz, tx, ty, tz)
    out[HITS], out[CONTACTS] = n_hits, n_contacts
    out[UNKNOWNS], out[DEEPEST] = n_unknown, deepest
    missed[LISTED] = n_missed


def _felt_plainly(law, cells, which, shell, pose, place, met, missed, out):
    """`felt` under any law."""
    felt(cells, which, shell, pose, place, law, met, missed, out)


def _frame_of(law_type: type) -> Any:  # noqa: ANN401 - numba's functions are untyped
    """What computes frames under that type of law."""
    of_laws: dict[type, Any] = {DistanceFieldLaw: felt_by_distance, TangentPlaneLaw: felt_by_plane}
    return of_laws.get(law_type, _felt_plainly)


frame_of = chosen_by_type(_frame_of)


@entry(FLOATS2, INT, FLOAT, FLOATS2)
def bounding_spheres(points, run, slack, out):
    """Sphere (C, 4) at the centre of the box of each run of points (N, 6), radius plus `slack`.

    The radius also has room for the stretch of a pose that `is_rigid` just accepts.
    """
    total = points.shape[0]
    for cluster in range(out.shape[0]):
        start = cluster * run
        end = min(start + run, total)
        for axis in range(3):
            low = high = points[start, axis]
            for n in range(start + 1, end):
                low = min(low, points[n, axis])
                high = max(high, points[n, axis])
            out[cluster, axis] = 0.5 * (low + high)
        furthest = 0.0
        for n in range(start, end):
            x = points[n, 0] - out[cluster, 0]
            y = points[n, 1] - out[cluster, 1]
            z = points[n, 2] - out[cluster, 2]
            furthest = max(furthest, x * x + y * y + z * z)
        out[cluster, 3] = np.sqrt(furthest) * (1.0 + 1e-5) + slack
