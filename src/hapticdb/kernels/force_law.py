"""Force law: response of a point of the shell, and the sum over a frame. Defined here alone.

A *hit* is a point inside an occupied voxel. Hits come from the occupancy alone and are the same
under every law. A law's response at a point is a penetration depth and a weight in the frame's
average; a point with a depth above 0 is a *contact*. A contact need not be a hit (a distance field
responds before the surface), nor a hit a contact (above the tangent plane it is not).

A law consists of a NamedTuple of its numbers, one of them the field `stiffness`, and of the
functions in `Leaves`, registered for its type by `define`. Kernels are compiled once for each type
of law. One compiled kernel with a branch on a number in the law would be worse: every frame would
pass the payload of every law, at 0.3 us an array, and user-defined laws would be impossible.

A *payload* is a law's input besides the occupancy: the distances of a frame's rows, or of the
resident cells (`hapticdb.kernels.field`). None stands for no payload and costs a frame nothing.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from hapticdb.kernels._jit import FLOAT, chosen_by_type, fields_of, leaf
from hapticdb.kernels.rigid import moment

AVERAGE_FROM = 10.0
"""Sum of weights from which on force and torque are averaged (McNeely et al. 1999, section 4.3).

Larger: stronger wrenches of frames with many contacts.
"""
NOTHING_NEAR = math.inf
"""Sample of a point without a surface nearby in the payload."""
NO_WRENCH = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Zero force and torque."""


def _no_sample_of_rows(law, payload, counts, first, end, x, y, z):  # noqa: ARG001 - as every such leaf
    """Sample, in rows, of a law without payload."""
    return NOTHING_NEAR


def _no_sample_of_slot(law, payload, slot, x, y, z):  # noqa: ARG001 - likewise
    """Sample, in a resident cell, of a law without payload."""
    return NOTHING_NEAR


def _full_share_of_rows(law, payload, counts, first, end, x, y, z, nx, ny, nz, sample):  # noqa: ARG001
    """Share, in rows, under a law independent of the normal's direction."""
    return 1.0


def _full_share_of_slot(law, payload, slot, x, y, z, nx, ny, nz, sample):  # noqa: ARG001
    """Share, in a resident cell, under such a law."""
    return 1.0


def _no_reach(law):  # noqa: ARG001 - the arguments of every such leaf
    """Reach of a law with contacts at hits alone."""
    return 0.0


class Leaves(NamedTuple):
    """Functions of one type of law: plain Python, compiled by numba into the kernels.

    respond : (law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size) -> depth, weight. The
        point is p, its inward normal n, the centre of its voxel c, world frame, metres; `size` is
        the voxel size. Depth in metres, above 0 for a contact. Weight in the average, from 0
        (ignored) to 1.
    reach : (law) -> largest sample, in voxels, of a contact without a hit. Points without a hit and
        with a sample above the reach are skipped.
    force_range : (law) -> distance in voxels. A point at least so far from every occupied voxel is
        no hit, and its sample is above the reach. Resident frames skip such points.
    sample_rows : (law, payload, counts, first, end, x, y, z) -> sample of the point (x, y, z), in
        voxels from the grid's origin. payload (R, 1000) uint8: distances of a frame's rows; rows
        first .. end - 1: the point's brick, one for each object near it; counts (R,) bool: False
        for the rows of excluded objects.
    sample_slot : (law, payload, slot, x, y, z) -> sample of the point in a slot of the resident
        cells; payload (S, 34^3) uint8. It must equal that of `sample_rows`.
    share_rows : as `sample_rows`, and then nx, ny, nz, sample -> factor, 0 to 1, of depth and
        weight of a point with the inward normal n and that sample.
    share_slot : as `sample_slot`, and then nx, ny, nz, sample -> the same factor as `share_rows`.
    """

    respond: Callable[..., Any]
    reach: Callable[..., Any] = _no_reach
    force_range: Callable[..., Any] = _no_reach
    sample_rows: Callable[..., Any] = _no_sample_of_rows
    sample_slot: Callable[..., Any] = _no_sample_of_slot
    share_rows: Callable[..., Any] = _full_share_of_rows
    share_slot: Callable[..., Any] = _full_share_of_slot


LEAVES: dict[type, Leaves] = {}
"""Functions of each type of law."""


def define(law_type: type, leaves: Leaves) -> None:
    """Register the functions of a type of law, before any kernel call with such a law."""
    LEAVES[law_type] = leaves


def reads_distances(law: Any) -> bool:  # noqa: ANN401 - a NamedTuple, or its type
    """Whether the payload in a frame of a law, or of a type of law, is the rows' distances."""
    law_type = law if isinstance(law, type) else type(law)
    return LEAVES[law_type].sample_rows is not _no_sample_of_rows


respond = chosen_by_type(lambda law_type: LEAVES[law_type].respond)
reach = chosen_by_type(lambda law_type: LEAVES[law_type].reach)
force_range = chosen_by_type(lambda law_type: LEAVES[law_type].force_range)
sample_rows = chosen_by_type(lambda law_type: LEAVES[law_type].sample_rows)
sample_slot = chosen_by_type(lambda law_type: LEAVES[law_type].sample_slot)
share_rows = chosen_by_type(lambda law_type: LEAVES[law_type].share_rows)
share_slot = chosen_by_type(lambda law_type: LEAVES[law_type].share_slot)


@leaf
def accumulate(sums, point, center, depth, stiffness):
    """Add one contact to a frame's force and torque: F = K d n, T = (p - m) x F.

    sums : force and torque so far, N and N m; point : p and n, six numbers or more; center : m, the
    tool's; depth : d, metres. Callers add in the order of the shell's points.
    """
    fx, fy, fz, tx, ty, tz = sums
    push = stiffness * depth
    x, y, z = push * point[3], push * point[4], push * point[5]
    rx, ry, rz = moment(point[0] - center[0], point[1] - center[1], point[2] - center[2], x, y, z)
    return fx + x, fy + y, fz + z, tx + rx, ty + ry, tz + rz


@leaf
def average_into(out, weight, sums):
    """Write the wrench to out (6+,), divided by a tenth of the weight from `AVERAGE_FROM` on."""
    tenth = weight / 10.0 if weight >= AVERAGE_FROM else 1.0
    for axis in range(6):
        out[axis] = sums[axis] / tenth


# --- the tangent plane ---------------------------------------------------------------------------


class TangentPlaneLaw(NamedTuple):
    """Tangent-plane law (McNeely, Puterbaugh and Troy 1999). stiffness: K, N/m."""

    stiffness: float


TANGENT_PLANE = fields_of(TangentPlaneLaw, FLOAT)


@leaf
def depth_below_plane(px, py, pz, nx, ny, nz, cx, cy, cz):
    """Depth below the plane through the voxel's centre c, metres: (c - p) . n, negative above."""
    return (cx - px) * nx + (cy - py) * ny + (cz - pz) * nz


def _tangent_plane(law, is_hit, sample, px, py, pz, nx, ny, nz, cx, cy, cz, size):  # noqa: ARG001
    """Depth below the tangent plane. Every hit counts in the average, even above the plane."""
    return depth_below_plane(px, py, pz, nx, ny, nz, cx, cy, cz), 1.0


define(TangentPlaneLaw, Leaves(respond=_tangent_plane))
