"""Distance of a shell from occupied voxels at poses that have nothing to do with one another.

The search of a pose stops at the first cell that is not resident, and says at which point. The
caller fetches cells there and continues the search; no distance is guessed.
"""

import math

import numpy as np

from hapticdb.kernels._jit import FLOAT, FLOATS, FLOATS3, INT, INTS, entry, inlined, leaf
from hapticdb.kernels.resident.cells import CELLS, CLUSTERS, GROUP, PLACE, begin_frame, end_frame
from hapticdb.kernels.resident.clearance import nearest_voxel, square_to
from hapticdb.kernels.rigid import moved, transform_of

POINT, RUN, GROUPED = 0, 1, 2
"""What is looked around at once: a point, a run of points, a group of runs."""


@inlined
def level_at(spheres, groups, run, point, largest):
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
def ball_at(points, spheres, groups, run, point, level):
    """Centre and radius, tool frame, metres, of what is looked around."""
    if level == POINT:
        return points[point, 0], points[point, 1], points[point, 2], 0.0
    if level == RUN:
        n = point // run
        return spheres[n, 0], spheres[n, 1], spheres[n, 2], spheres[n, 3]
    n = point // (GROUP * run)
    return groups[n, 0], groups[n, 1], groups[n, 2], groups[n, 3]


@leaf
def in_voxels(transform, place, x, y, z):
    """A point of the tool, metres, placed by a pose, in voxels from the grid's origin."""
    x, y, z = moved(transform, x, y, z)
    return (x - place.x) / place.size, (y - place.y) / place.size, (z - place.z) / place.size


@entry(CELLS, INT, CLUSTERS, FLOATS3, PLACE, FLOAT, FLOATS, INTS, INTS)
def find_nearest(cells, reader, shell, poses, place, largest, squares, nearest, done):
    """Least squared distance from the points to an occupied voxel's box at each of poses (B, 4, 4).

    largest: metres; a larger run is not looked around as a whole. squares (B,): the square of the
    greatest distance that is searched before, of the least distance after, voxels; nearest (B,)
    int64: the point, or -1 as long as nothing is nearer; done (B,) int64: points searched, 0
    before, N for a pose that is done. A pose with fewer has met a cell that is not resident. Its
    numbers are those of the points before, and a later call continues there.

    The voxel that was nearest last bounds the search at the next pose. So neighbouring poses should
    follow one another.
    """
    _, _, keys, slots, words, masks, used, _, _ = cells
    points, _, spheres, groups, run, _, _ = shell
    size, total = place.size, points.shape[0]
    seed, hot = np.int64(-1), np.int64(-1)
    which = begin_frame(cells, reader)
    for n in range(poses.shape[0]):
        if done[n] >= total:
            continue
        transform = transform_of(poses[n])
        square, best, at = squares[n], nearest[n], done[n]
        if seed >= 0 and hot >= 0:
            x, y, z = in_voxels(transform, place, points[hot, 0], points[hot, 1], points[hot, 2])
            bound = square_to(x, y, z, seed)
            if bound < square:
                square, best = bound, hot
        level = level_at(spheres, groups, run, at, largest)
        while at < total and square > 0.0:
            x, y, z, radius = ball_at(points, spheres, groups, run, at, level)
            x, y, z = in_voxels(transform, place, x, y, z)
            limit, voxel = square, np.int64(-1)
            if level != POINT:
                limit = (math.sqrt(square) + radius / size) ** 2
            if seed >= 0:
                bound = square_to(x, y, z, seed)
                if bound < limit:
                    limit, voxel = bound, seed
            if level == POINT or voxel < 0:
                limit, voxel = nearest_voxel(
                    keys, slots, words, masks, used, which, x, y, z, limit, voxel, place.side
                )
            if voxel == -2 and level == POINT:
                break
            if voxel >= 0:
                seed = voxel
            if level == POINT:
                if voxel >= 0:
                    square, best = limit, at
                at += 1
                level = level_at(spheres, groups, run, at, largest)
            elif voxel == -1:
                at += run if level == RUN else GROUP * run
                level = level_at(spheres, groups, run, at, largest)
            else:  # something is near, or unknown: look around less
                level = RUN if level == GROUPED and spheres[at // run, 3] <= largest else POINT
        squares[n], nearest[n] = square, best
        done[n] = total if square == 0.0 else min(at, total)
        hot = best
    end_frame(cells, reader)
