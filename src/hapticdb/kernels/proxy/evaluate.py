"""A contact proxy at a pose of the hand: the client's part, once a period of its loop.

The tool rests where the spring to the hand and the proxy's contacts balance, as in the quasi-static
coupling (`hand.step`, which solves for this, too). Each contact is one point of the tool and the
surface near it: a plane that may bend. A contact that the tool leaves ends, and one that it comes
to begins, so a proxy stays right across the edge of a face, where a linear spring does not.

Unknown is the tool's pose. From the pose of the server's last message a few Gauss-Newton steps go
to the balance, each over a predicted contact set. The result depends on the proxy and the hand
alone, not on earlier periods.
"""

import math

from hapticdb.kernels._jit import FLOATS, entry, leaf, record_of
from hapticdb.kernels.hand.device_spring import BEYOND_CAP, pull_to, stretch, wrench_of
from hapticdb.kernels.hand.near_points import (
    ACTIVE,
    ALONG,
    NEAR,
    NEAR_POINTS,
    NEAR_ROWS,
    ONSETS,
    WEIGHTS,
    U,
    write_along,
    write_bends,
)
from hapticdb.kernels.hand.path import turned_on, way_of_step
from hapticdb.kernels.hand.step import solve_step
from hapticdb.kernels.records import CONTACT_MODEL, CONTACT_ROWS
from hapticdb.kernels.rigid import moment, product, turned_by

assert NEAR + NEAR_ROWS == CONTACT_ROWS  # noqa: S101 - rows that are written

STEPS = 5
"""Most Gauss-Newton steps of an evaluation. Larger: nearer to the balance far from the proxy's pose
and round edges, and a longer worst case."""
ROUNDS = 4
"""Most times that a step is solved until its contact set stays the same. Larger: likewise, in
corners."""
SETTLED = 1e-7
"""Metres: a step in which no point moves farther is the last. Larger: fewer steps, less exact."""
WRENCH, WAY, PUSHING, RESULTS = 0, 6, 7, 8
"""Indices into an evaluation's result (RESULTS,): wrench on the hand about the handle's origin, N
and N m; way of the tool's farthest point in the hand since the proxy's pose, m; number of contacts
that push."""


@leaf
def measure_pull(model, hand, lever):
    """Stretch and turn from tool to hand: see `device_spring.stretch`."""
    pull_to(model.pull, hand, lever, model.position, model.quaternion)
    most, most_turn = BEYOND_CAP * model.cap, BEYOND_CAP * model.turn_cap
    stretch(model, model.spring, model.turn_spring, most, most_turn)


@leaf
def _begin_contacts(model):
    """Make the planes near points, at no pose yet; what a hollow surface resists stays the same."""
    rows, model.n_near, model.is_bent = model.rows, model.n_planes, True
    for n in range(model.n_planes):
        normal, along, bends = model.normals[n], model.along[n], model.bends[n]
        wx, wy, wz = moment(normal[0], normal[1], normal[2], along[0], along[1], along[2])
        model.met[NEAR_POINTS, n] = n
        rows[ONSETS, n], rows[WEIGHTS, n], rows[ACTIVE, n] = model.onset, model.weights[n], 0.0
        bends = -bends[0], along[0], along[1], along[2], -bends[1], wx, wy, wz
        write_bends(rows, NEAR, n, model.levers[n], bends)


@leaf
def _place_contacts(model):
    """Distance of each contact at the tool's pose, its gradient and moment, into model.rows.

    A point that has moved by a along the normal and by p and q across it is at the distance
    sqrt((u + a)^2 + u (c p^2 + e q^2)) from a surface that bulges with curvatures c and e, u its
    distance before: exact round planes, edges and corners, and to second order elsewhere. Where the
    surface is hollow, or the point lies behind it (u < 0, which only a wrong server sends), the
    distance is u + a + (c p^2 + e q^2) / 2.
    """
    turned, first, at = model.quaternion, model.tool, model.position
    tw, tx, ty, tz = product(
        turned[0], turned[1], turned[2], turned[3], first[3], -first[4], -first[5], -first[6]
    )
    for n in range(model.n_planes):
        lever, normal, along, bends = (
            model.levers[n], model.normals[n], model.along[n], model.bends[n],
        )  # fmt: skip
        rx, ry, rz = turned_by(tw, tx, ty, tz, lever[0], lever[1], lever[2])
        dx = at[0] - first[0] + rx - lever[0]
        dy = at[1] - first[1] + ry - lever[1]
        dz = at[2] - first[2] + rz - lever[2]
        nx, ny, nz = normal[0], normal[1], normal[2]
        vx, vy, vz = along[0], along[1], along[2]
        wx, wy, wz = moment(nx, ny, nz, vx, vy, vz)
        a = nx * dx + ny * dy + nz * dz
        p = bends[0] * (vx * dx + vy * dy + vz * dz)
        q = bends[1] * (wx * dx + wy * dy + wz * dz)
        bent = p * (vx * dx + vy * dy + vz * dz) + q * (wx * dx + wy * dy + wz * dz)
        u = model.onset - model.depths[n]
        if bent > 0.0 and u >= 0.0 and u + a > 0.0:
            after = math.sqrt((u + a) * (u + a) + u * bent)
            slope, sideways = (u + a) / after, u / after
        else:
            after, slope, sideways = u + a + 0.5 * bent, 1.0, 1.0
        gx = slope * nx + sideways * (p * vx + q * wx)
        gy = slope * ny + sideways * (p * vy + q * wy)
        gz = slope * nz + sideways * (p * vz + q * wz)
        model.rows[NEAR + U, n] = after
        write_along(model.rows, NEAR + ALONG, n, (rx, ry, rz), gx, gy, gz)


@leaf
def _take_step(model):
    """Move the tool by the step -> the way that no point of it exceeds, m."""
    turned = model.quaternion
    for axis in range(3):
        model.position[axis] += model.step[axis]
    w, x, y, z, length = turned_on(model.step, 1.0, turned)
    turned[0], turned[1], turned[2], turned[3] = w / length, x / length, y / length, z / length
    return way_of_step(model, model.radius, 1.0)


@entry(record_of(CONTACT_MODEL), FLOATS, FLOATS)
def evaluate(model_record, hand, result):
    """Evaluate a proxy with the handle at (7,), into result (RESULTS,).

    hand: position, m, and unit quaternion of the handle, scalar first, in the scene. The force is
    at most `cap`, and the torque about the tool's centre in the hand at most `turn_cap`; both are
    exactly zero where no contact pushes.
    """
    model = model_record[()]
    center = model.center
    lever = turned_by(hand[3], hand[4], hand[5], hand[6], center[0], center[1], center[2])
    for axis in range(3):
        model.position[axis] = model.tool[axis]
    for part in range(4):
        model.quaternion[part] = model.tool[3 + part]
    for n in range(RESULTS):
        result[n] = 0.0
    pull_to(model.step, hand, lever, model.hand, model.hand[3:])
    result[WAY] = way_of_step(model, model.radius, 1.0)
    if model.n_planes == 0:
        return
    _begin_contacts(model)
    for _ in range(STEPS):
        measure_pull(model, hand, lever)
        _place_contacts(model)
        solve_step(model, model.rows, model.met, 1.0, model.contact, 0.0, 0.0, ROUNDS)
        if _take_step(model) < SETTLED:
            break
    if model.n_active == 0:
        return
    measure_pull(model, hand, lever)
    x, y, z, a, b, c = wrench_of(model, model.cap, model.turn_cap)
    mx, my, mz = moment(*lever, x, y, z)
    result[WRENCH], result[WRENCH + 1], result[WRENCH + 2] = x, y, z
    result[WRENCH + 3], result[WRENCH + 4], result[WRENCH + 5] = a + mx, b + my, c + mz
    result[PUSHING] = model.n_active
