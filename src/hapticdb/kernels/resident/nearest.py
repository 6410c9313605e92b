"""Distance of a shell from occupied voxels at poses that have nothing to do with one another.

Balls of points are looked around before their points: groups of runs, then runs. What was found
around a place is remembered for its cube of space (`records.NEAR_CUBE`), and bounds the distance of
every place in that cube. So most balls and points are left out without a search, at this pose and
at later ones.

The search of a pose stops at the first cell that is not resident, and says at which point. The
caller fetches cells there and continues the search; no distance is guessed.
"""

import math

import numpy as np

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS3, INT, INTS, entry, inlined, leaf, record_of
from hapticdb.kernels.records import NEAR_CUBE
from hapticdb.kernels.resident.cells import (
    CELLS,
    CLUSTERS,
    GROUP,
    PLACE,
    begin_frame,
    end_frame,
    spread_key,
)
from hapticdb.kernels.resident.clearance import nearest_voxel, packed, square_to
from hapticdb.kernels.rigid import moved, transform_of

CAUTION = 1e-6
"""Voxels by which a bound is lowered, so that rounding errors cannot make it wrong."""
POINT, RUN, GROUPED = 0, 1, 2
"""What is looked around at once: a point, a run of points, a group of runs."""
CUBE_OF_BALL = 2
"""Binary logarithm of the edge, voxels, of the cubes that balls are in. A larger cube is met again
more often, and bounds the distance less closely."""
SURVEY, NEAREST_BALL, ALL = 0, 1, 2
"""Turns of a pose's search: bounds of all balls, the points of the ball that may be nearest, and
all that may be nearer than these."""


NOT_KNOWN = np.zeros((), NEAR_CUBE)
"""A cube of which nothing is known. What is known holds for one revision, and each thread needs
cubes of its own: an array (F,) of such records, F a power of two, in which one replaces another."""
NOT_KNOWN["key"] = NOT_KNOWN["nearest"] = -1
NOT_KNOWN["bound"] = -1.0


@inlined
def _level_at(spheres, groups, run, point, largest):
    """What the search looks around next, where it has come to a point.

    It is the largest of GROUPED, RUN and POINT that begins there and has a radius of `largest` m or
    less.
    """
    if spheres.shape[0] == 0 or point % run != 0 or point // run >= spheres.shape[0]:
        return POINT
    if point % (GROUP * run) == 0 and groups[point // (GROUP * run), 3] <= largest:
        return GROUPED
    return RUN if spheres[point // run, 3] <= largest else POINT


@inlined
def _ball_at(points, spheres, groups, run, point, level):
    """Centre and radius, tool frame, metres, of what is looked around, and its number of points."""
    if level == POINT:
        return points[point, 0], points[point, 1], points[point, 2], 0.0, np.int64(1)
    if level == RUN:
        n = point // run
        return spheres[n, 0], spheres[n, 1], spheres[n, 2], spheres[n, 3], run
    n = point // (GROUP * run)
    return groups[n, 0], groups[n, 1], groups[n, 2], groups[n, 3], GROUP * run


@leaf
def in_voxels(transform, place, x, y, z):
    """A point of the tool, metres, placed by a pose, in voxels from the grid's origin."""
    x, y, z = moved(transform, x, y, z)
    return (x - place.x) / place.size, (y - place.y) / place.size, (z - place.z) / place.size


@leaf
def _bounded_by(x, y, z, square, voxel):
    """Squared distance to a voxel, or -1, with which a search begins: the voxel if it is nearer."""
    if voxel >= 0 and square_to(x, y, z, voxel) < square:
        return square_to(x, y, z, voxel), voxel
    return square, np.int64(-1)


@leaf
def length(x, y, z):
    """Length of a vector."""
    return math.sqrt(x * x + y * y + z * z)


@inlined
def bound_at(
    cubes, keys, slots, words, masks, used, which, x, y, z, wanted, near, shift, side
):  # fmt: skip
    """Lower bound of the distance from (x, y, z) to an occupied voxel, and a voxel near it or -1.

    All in voxels. Looks the place's cube up, or searches around its middle as far as decides
    whether a voxel is nearer than `wanted` to any place in it. near: an occupied voxel with which a
    search begins, or -1. The bound is 0 outside the grid, and where a cell is not resident.
    """
    if not (0.0 <= x < side and 0.0 <= y < side and 0.0 <= z < side):
        return 0.0, np.int64(-1)
    edge = 1.0 * (np.int64(1) << shift)
    i, j, k = np.int64(x) >> shift, np.int64(y) >> shift, np.int64(z) >> shift
    mx, my, mz = (i + 0.5) * edge, (j + 0.5) * edge, (k + 0.5) * edge
    key = packed(i, j, k) << 1 | (shift == CUBE_OF_BALL)
    cube = cubes[spread_key(key, cubes.shape[0])]
    far = wanted + 0.5 * math.sqrt(3.0) * edge
    if cube.key != key or (cube.nearest < 0 and cube.bound < far):
        square, voxel = _bounded_by(mx, my, mz, far * far, near)
        square, voxel = nearest_voxel(
            keys, slots, words, masks, used, which, mx, my, mz, square, voxel, side
        )
        if voxel == -2:
            return 0.0, np.int64(-1)
        cube.key = key
        cube.bound = math.sqrt(square)
        cube.nearest = voxel
    return cube.bound - length(x - mx, y - my, z - mz) - CAUTION, cube.nearest


@leaf
def promised(x, y, z, voxel):
    """Distance to a known voxel at most, for which -1 promises nothing."""
    return math.sqrt(square_to(x, y, z, voxel)) + CAUTION if voxel >= 0 else np.inf


@entry(
    CELLS, INT, CLUSTERS, FLOATS3, PLACE, FLOAT, INT, record_of(NEAR_CUBE, 1), FLOATS, INTS, INTS
)
def find_nearest(cells, reader, shell, poses, place, largest, fine, cubes, squares, nearest, done):
    """Least squared distance from the points to an occupied voxel's box at each of poses (B, 4, 4).

    largest: metres; a larger run is not looked around as a whole. fine: binary logarithm of the
    edge, voxels, of the cubes that points are in, at most `CUBE_OF_BALL`. squares (B,): the
    greatest distance to search before, the least after, squared, voxels; nearest (B,): the point,
    or -1 while nothing is nearer; done (B,): points searched. With fewer than N a pose has met a
    cell that is not resident, and a later call continues there.
    """
    _, _, keys, slots, words, masks, used, _, _ = cells
    points, _, spheres, groups, run, _, _ = shell
    size, side, total = place.size, place.side, points.shape[0]
    seed = hot = near = np.int64(-1)
    which = begin_frame(cells, reader)
    for n in range(poses.shape[0]):
        if done[n] >= total:
            continue
        transform = transform_of(poses[n])
        square, best = squares[n], nearest[n]
        if seed >= 0 and hot >= 0:  # the voxel that was nearest at the pose before
            point = in_voxels(transform, place, points[hot, 0], points[hot, 1], points[hot, 2])
            bound = square_to(point[0], point[1], point[2], seed)
            square, best = (bound, hot) if bound < square else (square, best)
        within, least, first, first_end = math.sqrt(square), np.inf, np.int64(0), np.int64(0)
        for turn in range(SURVEY if done[n] == 0 else ALL, ALL + 1):
            begin = done[n] if turn == ALL else np.int64(0)
            at, end = (first, first_end) if turn == NEAREST_BALL else (begin, total)
            level = _level_at(spheres, groups, run, at, largest)
            while at < end and within > 0.0 and (turn != SURVEY or level != POINT):
                x, y, z, radius, n_points = _ball_at(points, spheres, groups, run, at, level)
                x, y, z = in_voxels(transform, place, x, y, z)
                radius /= size
                bound, voxel = bound_at(
                    cubes, keys, slots, words, masks, used, which, x, y, z, within + radius, near,
                    fine if level == POINT else CUBE_OF_BALL, side,
                )  # fmt: skip
                near = voxel if voxel >= 0 else near
                if turn == SURVEY:
                    if bound - radius < least:
                        least, first, first_end = bound - radius, at, min(at + n_points, total)
                    within = min(within, promised(x, y, z, voxel) + radius)
                elif bound < within + radius and level != POINT:
                    level = RUN if level == GROUPED and spheres[at // run, 3] <= largest else POINT
                    continue
                elif bound < within:
                    limit, voxel = _bounded_by(x, y, z, within * within, voxel)
                    limit, voxel = nearest_voxel(
                        keys, slots, words, masks, used, which, x, y, z, limit, voxel, side
                    )
                    if voxel == -2:
                        break
                    if voxel >= 0:
                        seed, square, best, within = voxel, limit, at, math.sqrt(limit)
                at += n_points
                level = _level_at(spheres, groups, run, at, largest)
        squares[n], nearest[n] = square, best
        done[n] = total if square == 0.0 else min(at, total)
        hot = best
    end_frame(cells, reader)
