"""How the force changes with the hand: the stiffness K6 of a contact proxy, and where it stands.

The hand feels the spring, with the tangent stiffness S, in series with the contacts. These have the
stiffness C = sum of K J J^T over the points that push, with J = (n; r x n), and of their curvature.
For a way dh of the hand the balance S (dh - dx) = C dx moves the tool by dx = (S + C)^-1 S dh, so
that

    K6 = -dW/dx = S - S (S + C)^-1 S

which is symmetric, and never stiffer than the spring (two springs in series; Mark et al. 1996 send
planes for that reason, Otaduy and Lin 2006 the linear model).
"""

from hapticdb.kernels._jit import (
    FLOATS2,
    INT,
    entry,
    leaf,
    record_of,
)
from hapticdb.kernels.field.law import ONSET
from hapticdb.kernels.hand.device_spring import (
    DEVICE_SPRING,
    contact_stiffness,
    lever_in_hand,
    wrench_of,
)
from hapticdb.kernels.hand.holding import IS_CUT, IS_HELD
from hapticdb.kernels.hand.quasistatic import IS_LOOSE
from hapticdb.kernels.hand.step import add_row, factor, solve
from hapticdb.kernels.proxy.planes import (
    ALONG,
    BEND,
    DEPTH,
    LEVER,
    NORMAL,
    find_rows,
    group_rows,
    write_planes,
)
from hapticdb.kernels.records import CONTACT_MODEL, FOLLOWER, SERVO
from hapticdb.kernels.resident.cells import (
    CELLS_WITH_DISTANCES,
    CLUSTERS,
    PLACE,
    begin_frame,
    end_frame,
)
from hapticdb.kernels.rigid import length_at, moment, moved, transform_of

MOST_BULGE = 0.5
"""Share of what the springs resist up to which bulging surfaces lower K6. There the force turns
with the hand; beyond 1 the tool snaps off, which no linear model can tell. Larger: nearer to that.
"""
MOST_TRUST = 1.0
"""Voxels: greatest trust radius with contacts near, because faces end. Larger: clients rely longer
on planes that may have ended."""


@leaf
def _write_hand(spring, shell, tool, hand, follower, flags, model):
    """Poses, springs and the wrench on the hand into a model."""
    lx, ly, lz = lever_in_hand(hand, shell.center)
    transform = transform_of(tool.pose)
    cx, cy, cz = moved(transform, shell.center[0], shell.center[1], shell.center[2])
    at, center = hand.position, shell.center
    model.center[0], model.center[1], model.center[2] = center[0], center[1], center[2]
    model.hand[0], model.hand[1], model.hand[2] = at[0] + lx, at[1] + ly, at[2] + lz
    model.tool[0], model.tool[1], model.tool[2] = cx, cy, cz
    for part in range(4):
        model.hand[3 + part] = hand.quaternion[part]
        model.tool[3 + part] = tool.quaternion[part]
    model.radius, model.cap = spring.radius, spring.cap
    model.turn_cap = spring.turn_cap * spring.scale
    model.spring = follower.share * spring.stiffness / spring.scale
    model.turn_spring = follower.share * spring.turn_stiffness * spring.scale
    for axis in range(6):
        model.pull[axis] = follower.pull[axis]
    is_felt = (follower.n_active > 0 or flags & IS_CUT) and not flags & (IS_LOOSE | IS_HELD)
    wrench = model.wrench
    for axis in range(6):
        wrench[axis] = 0.0
    if is_felt:
        wrench[0], wrench[1], wrench[2], wrench[3], wrench[4], wrench[5] = wrench_of(
            follower, model.cap, model.turn_cap
        )
    return is_felt


@leaf
def _add_spring(model, start, stiffness, cap):
    """Add the tangent stiffness of three axes from `start` on to model.stiffness (6, 6).

    A spring at its cap gives way along its pull and turns across it: returns whether it is there.
    """
    wrench = model.wrench
    size = length_at(wrench, start)
    is_capped = size >= cap * (1.0 - 1e-9)
    across = stiffness
    if is_capped:
        across = min(stiffness, cap / max(length_at(model.pull, start), 1e-12))
    for row in range(3):
        for column in range(3):
            value = across if row == column else 0.0
            if is_capped:
                value -= across * wrench[start + row] * wrench[start + column] / (size * size)
            model.stiffness[start + row, start + column] = value
    return is_capped


@leaf
def _add_contacts(model, rows, count, is_capped):
    """Add the stiffness of the rows in contact to the lower triangle of model.matrix.

    A bulge b at a lever r takes at most b (1 / k + r^2 / k_R) of what the springs resist; they
    resist nothing along a pull at its cap, where bulges are left out.
    """
    bulge = 0.0
    for n in range(count):
        if rows[n, DEPTH] > 0.0:
            force, lever = model.contact * rows[n, DEPTH], length_at(rows[n], LEVER)
            gives = 1.0 / model.spring + lever * lever / model.turn_spring
            bulge += force * gives * (max(rows[n, BEND], 0.0) + max(rows[n, BEND + 1], 0.0))
    share = 0.0 if is_capped else min(1.0, MOST_BULGE / max(bulge, 1e-12))
    for n in range(count):
        depth = rows[n, DEPTH]
        if depth <= 0.0:
            continue
        nx, ny, nz = rows[n, NORMAL], rows[n, NORMAL + 1], rows[n, NORMAL + 2]
        rx, ry, rz = rows[n, LEVER], rows[n, LEVER + 1], rows[n, LEVER + 2]
        add_row(model, model.contact, 0.0, nx, ny, nz, *moment(rx, ry, rz, nx, ny, nz))
        vx, vy, vz = rows[n, ALONG], rows[n, ALONG + 1], rows[n, ALONG + 2]
        for bend in range(2):
            curvature = rows[n, BEND + bend]
            if curvature != 0.0:
                weight = -model.contact * depth * curvature * (share if curvature > 0.0 else 1.0)
                add_row(model, weight, 0.0, vx, vy, vz, *moment(rx, ry, rz, vx, vy, vz))
            vx, vy, vz = moment(nx, ny, nz, vx, vy, vz)


@leaf
def _write_stiffness(model, rows, count):
    """Write K6 into model.stiffness, which is zero, from the rows in contact and the springs."""
    is_capped = _add_spring(model, 0, model.spring, model.cap)
    is_capped |= _add_spring(model, 3, model.turn_spring, model.turn_cap)
    spring = model.rows
    for row in range(6):
        for column in range(6):
            spring[row, column] = model.stiffness[row, column]
            model.matrix[row, column] = spring[row, column]
        model.matrix[row, row] += 1e-9 * (model.spring if row < 3 else model.turn_spring)
    _add_contacts(model, rows, count, is_capped)
    factor(model)
    for column in range(6):
        for row in range(6):
            model.right[row] = spring[row, column]
        solve(model)
        for row in range(6):
            total = spring[row, column]
            for other in range(6):
                total -= spring[row, other] * model.step[other]
            model.stiffness[row, column] = total
    for row in range(6):
        for column in range(row):
            mean = 0.5 * (model.stiffness[row, column] + model.stiffness[column, row])
            model.stiffness[row, column] = model.stiffness[column, row] = mean


@entry(
    CELLS_WITH_DISTANCES, INT, CLUSTERS, PLACE, DEVICE_SPRING, record_of(SERVO),
    record_of(FOLLOWER), FLOATS2, FLOATS2, record_of(CONTACT_MODEL),
)  # fmt: skip
def linearize(
    cells, reader, shell, place, spring, servo_record, follower_record, field, rows, model_record
):
    """Write the contacts around the tool's pose into model_record (); see `records.CONTACT_MODEL`.

    Call it after `hand.quasistatic.advance` with the same cells, records and field; neither is
    changed. rows (N, ROW_COLUMNS): scratch, N the shell's points. A tool that lies in something, or
    whose cells are unknown, has no planes and no force.
    """
    servo, follower, model = servo_record[()], follower_record[()], model_record[()]
    tool, hand, sent = servo.tool, servo.hand, servo.sent
    is_felt = _write_hand(spring, shell, tool, hand, follower, sent.marks, model)
    model.contact, model.onset = contact_stiffness(spring, place.size), ONSET * place.size
    model.n_planes, model.trust = 0, 0.0
    for row in range(6):
        for column in range(6):
            model.stiffness[row, column] = 0.0
    if sent.marks & (IS_LOOSE | IS_HELD) or tool.version == 0:
        return
    which = begin_frame(cells, reader)
    count, trust = find_rows(cells, which, shell, place, tool, follower, field, rows)
    end_frame(cells, reader)
    if is_felt:
        _write_stiffness(model, rows, count)
    n_planes = group_rows(rows, count, spring.radius, place.size)
    write_planes(model, rows, count, n_planes, place.size)
    # below 0 in a narrow gap, where no gradient tells which side is nearer
    model.trust = place.size * max(min(trust, MOST_TRUST) if count > 0 else trust, 0.0)
