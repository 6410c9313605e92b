"""Near voxels: the voxels in range of the distance law.

A voxel is near if a lower bound of the distances in it is at most the law's reach. The bound comes
from the stored distances of a frame's interpolation, so no point in range is missed.

Proof. In a voxel, the interpolated distance takes its least value at one of 27 points: the voxel's
centre, its corners and the middles of its faces and edges; it is trilinear between them. On one
axis these are the centre, with the value c, and the two borders, with the means of c and a
neighbour. The least of the three is (c + min(before, c, after)) / 2. This least value along k, then
of the results along j, then along i, is a lower bound of all 27: a mean of least values is never
above the least mean. The bound is exact for distances falling along each axis in one direction.
"""

import numpy as np

from hapticdb.kernels._jit import BYTES2, INTS, WORDS, WORDS32_2, entry
from hapticdb.kernels.field.distance_law import REACH
from hapticdb.kernels.field.lattice import CELL_SIDE, STEPS, VOXELS_A_STEP
from hapticdb.kernels.resident.cells import CELL_WORDS

MOST_EIGHTHS = int(8 * REACH / VOXELS_A_STEP)
"""Largest bound of a near voxel, in eighths of a step. The next eighth is a thousandth of a voxel
above the reach, far more than the rounding of a frame."""
SIDE = 32
"""Voxels of a cell on each axis."""


@entry(INTS, BYTES2, WORDS, WORDS32_2, WORDS32_2)
def mark_near_voxels(places, payload, masks, words, near):
    """Write the near voxels of cells in slots places (n,) from their distances and their voxels.

    payload (S, 34^3) uint8; masks (S,) uint64; words, near (S, 1024) uint32. Occupied voxels count
    as near. A brick with a mask bit of 0 has none, since a frame on rows finds no row there. The
    loops along k are plain, for vectorization.
    """
    along_k = np.empty((CELL_SIDE * CELL_SIDE, SIDE), dtype=np.int16)
    along_j = np.empty((CELL_SIDE * SIDE, SIDE), dtype=np.int16)
    for n in range(places.shape[0]):
        slot = places[n]
        for word in range(CELL_WORDS):
            near[slot, word] = 0
        if masks[slot] == 0:
            continue
        for line in range(CELL_SIDE * CELL_SIDE):
            at = line * CELL_SIDE
            for k in range(SIDE):
                middle = np.int16(min(payload[slot, at + k + 1], STEPS))
                beside = np.int16(min(payload[slot, at + k], payload[slot, at + k + 2]))
                # twice the least value; the axes j and i double it again, hence eighths
                along_k[line, k] = middle + min(middle, beside)
        for i in range(CELL_SIDE):
            for j in range(SIDE):
                at = i * CELL_SIDE + j
                for k in range(SIDE):
                    middle = along_k[at + 1, k]
                    beside = min(along_k[at, k], along_k[at + 2, k])
                    along_j[i * SIDE + j, k] = middle + min(middle, beside)
        for word in range(CELL_WORDS):
            bits = np.int64(words[slot, word])
            for k in range(SIDE):
                middle = along_j[word + SIDE, k]
                beside = min(along_j[word, k], along_j[word + 2 * SIDE, k])
                bits |= np.int64(middle + min(middle, beside) <= MOST_EIGHTHS) << k
            bricks = masks[slot] >> np.uint64((word >> 8) << 4 | ((word >> 3) & 3) << 2)
            known = np.int64(0)
            for brick in range(4):
                # a byte of the word is a brick's part of the column
                known |= (np.int64(bricks >> np.uint64(brick)) & 1) * (np.int64(0xFF) << 8 * brick)
            near[slot, word] = bits & known
