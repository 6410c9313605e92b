"""The band: quantised unsigned distances at voxel centres, in rows and in resident cells.

A distance u, in voxels, is that of a voxel's centre to the nearest triangle of an object, or to the
nearest point of a point cloud. It is stored in 8 bits: q = min(round(254 u / h), 254), and 255 for
u above h, the half width of the band.

A row of the table `brick` belongs to one brick and one object. It has the distances at 10^3
centres: the brick's own 8^3 and one more on each side. So one row has the 8 centres of trilinear
interpolation, and the 27 of a quadratic B-spline, around each point of the brick. A resident cell
has 34^3 distances for the same reason. In both, k runs fastest.
"""

from hapticdb.kernels._jit import leaf

HALF_WIDTH = 2.75
"""h, voxels: greatest stored distance. Larger: smoother forces and larger databases. Part of the
file format."""
STEPS = 254
"""Steps from distance 0 to h."""
BEYOND = 255
"""Stored value of distances above h."""
ROW_SIDE = 10
"""Centres of a row on each axis: a brick's 8, and one on each side."""
ROW_VALUES = ROW_SIDE**3
"""Distances in a row."""
CELL_SIDE = 34
"""Centres of a resident cell on each axis: its 32, and one on each side."""
CELL_VALUES = CELL_SIDE**3
"""Distances in a resident cell."""
VOXELS_A_STEP = HALF_WIDTH / STEPS
"""Length of a step, voxels."""


@leaf
def step_of(distance):
    """Stored value of a distance in voxels."""
    if distance > HALF_WIDTH:
        return BEYOND
    # to nearest: LARGEST_ERROR is half a step
    return int(distance / VOXELS_A_STEP + 0.5)


@leaf
def row_place(x, y, z):
    """Index in a row of centre (x, y, z), relative to the brick's first: -1 to 8."""
    return ((x + 1) * ROW_SIDE + (y + 1)) * ROW_SIDE + (z + 1)


@leaf
def cell_place(x, y, z):
    """Index in a cell of centre (x, y, z), relative to the cell's first: -1 to 32."""
    return ((x + 1) * CELL_SIDE + (y + 1)) * CELL_SIDE + (z + 1)


@leaf
def place_before(x, y, z):
    """Index offset in a cell from centre (0, 0, 0) to centre (x, y, z), of any cell."""
    return (x * CELL_SIDE + y) * CELL_SIDE + z


@leaf
def trilinear(u000, u001, u010, u011, u100, u101, u110, u111, x, y, z):
    """Trilinear interpolation between 8 corners; x, y, z in [0, 1] from corner 000."""
    # this order of operations is fixed: `corners.interpolated` repeats it bit for bit
    u00 = u000 + z * (u001 - u000)
    u01 = u010 + z * (u011 - u010)
    u10 = u100 + z * (u101 - u100)
    u11 = u110 + z * (u111 - u110)
    u0 = u00 + y * (u01 - u00)
    u1 = u10 + y * (u11 - u10)
    return u0 + x * (u1 - u0)
