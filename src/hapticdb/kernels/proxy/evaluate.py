"""A contact proxy at a pose of the hand: the client's part, once a period of its loop.

The tool rests where the spring to the hand and the proxy's contacts balance, as in the quasi-static
coupling (`hand.step`, whose energy this is). Each contact is one point of the tool and the surface
near it: a plane that may bend. A contact that the tool leaves ends, and one that it comes to
begins, so a proxy stays right across the edge of a face, where a linear spring does not.

Unknown is the tool's pose. From the pose of the server's last message a few Gauss-Newton steps go
to the balance, each over a predicted contact set. The result depends on the proxy and the hand
alone, not on earlier periods.
"""

import math

from hapticdb.kernels._jit import FLOATS, entry, leaf, record_of
from hapticdb.kernels.hand.device_spring import BEYOND_CAP, pull_to, stretch, wrench_of
from hapticdb.kernels.hand.path import way_of_step
from hapticdb.kernels.hand.step import add_row, begin_equations, factor, solve
from hapticdb.kernels.records import CONTACT_MODEL
from hapticdb.kernels.rigid import moment, product, quaternion_by, turned_by

STEPS = 5
"""Most Gauss-Newton steps of an evaluation. Larger: nearer to the balance far from the proxy's pose
and round edges, and a longer worst case."""
ROUNDS = 4
"""Most times that a step is solved until its contact set stays the same. Larger: likewise, in
corners."""
SETTLED = 1e-7
"""Metres: a step in which no point moves farther is the last. Larger: fewer steps, less exact."""
WRENCH, WAY, ACTIVE, RESULTS = 0, 6, 7, 8
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
def _place_contacts(model):
    """Rows of the contacts at the tool's pose: gradient, its moment and depth, into model.rows.

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
        row = model.rows[n]
        row[0], row[1], row[2] = gx, gy, gz
        row[3], row[4], row[5] = moment(rx, ry, rz, gx, gy, gz)
        row[6] = model.onset - after


@leaf
def _predict(model):
    """Put the contacts that the step leaves in depth into the set -> whether it changed."""
    step, n_changed = model.step, 0
    for n in range(model.n_planes):
        row = model.rows[n]
        depth = row[6]
        for axis in range(6):
            depth -= row[axis] * step[axis]
        active = 1 if depth > 0.0 else 0
        n_changed += active != model.is_active[n]
        model.is_active[n] = active
    return n_changed > 0


@leaf
def _add_hollow(model, n):
    """Add what a hollow surface resists across the normal of contact n that is in depth."""
    row, lever = model.rows[n], model.levers[n]
    normal, along = model.normals[n], model.along[n]
    wx, wy, wz = moment(normal[0], normal[1], normal[2], along[0], along[1], along[2])
    for bend in range(2):
        curvature = -model.bends[n, bend]
        if curvature > 0.0:
            vx = along[0] if bend == 0 else wx
            vy = along[1] if bend == 0 else wy
            vz = along[2] if bend == 0 else wz
            ax, ay, az = moment(lever[0], lever[1], lever[2], vx, vy, vz)
            weight = model.contact * model.weights[n] * row[6] * curvature
            add_row(model, weight, 0.0, vx, vy, vz, ax, ay, az)


@leaf
def _solve_step(model):
    """Solve for the step (6,), m and rad about the tool's centre, and its contact set."""
    for axis in range(6):
        model.step[axis] = 0.0
    _predict(model)
    for _ in range(ROUNDS):
        begin_equations(model, 0.0, 0.0)
        for n in range(model.n_planes):
            if model.is_active[n] == 1:
                row = model.rows[n]
                add_row(
                    model, model.contact * model.weights[n], row[6],
                    row[0], row[1], row[2], row[3], row[4], row[5],
                )  # fmt: skip
                if row[6] > 0.0:
                    _add_hollow(model, n)
        factor(model)
        solve(model)
        if not _predict(model):
            return


@leaf
def _take_step(model):
    """Move the tool by the step -> the way that no point of it exceeds, m."""
    step, at, turned = model.step, model.position, model.quaternion
    for axis in range(3):
        at[axis] += step[axis]
    w, x, y, z = product(
        *quaternion_by(step[3], step[4], step[5]), turned[0], turned[1], turned[2], turned[3]
    )
    length = math.sqrt(w * w + x * x + y * y + z * z)
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
    for n in range(model.n_planes):
        model.is_active[n] = 0
    for _ in range(STEPS):
        measure_pull(model, hand, lever)
        _place_contacts(model)
        _solve_step(model)
        if _take_step(model) < SETTLED:
            break
    count = 0
    for n in range(model.n_planes):
        count += model.is_active[n]
    if count == 0:
        return
    measure_pull(model, hand, lever)
    x, y, z, a, b, c = wrench_of(model, model.cap, model.turn_cap)
    mx, my, mz = moment(*lever, x, y, z)
    result[WRENCH], result[WRENCH + 1], result[WRENCH + 2] = x, y, z
    result[WRENCH + 3], result[WRENCH + 4], result[WRENCH + 5] = a + mx, b + my, c + mz
    result[ACTIVE] = count
