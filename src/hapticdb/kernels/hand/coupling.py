"""Virtual coupling: a rigid body between the hand and the shell, one period of the loop at a time.

The tool is a body with a mass and one moment of inertia. A spring and a damper pull it to the
handle, and the contact wrench pushes it. The body moves by semi-implicit steps, with the damper
implicit. No point moves more than half a voxel in a step.

These forces alone let a fast tool pass through a thin sheet. So a step that a hit may not make (see
`anchors`) is cut back: impulses first remove the point's speed against the outward direction, then
its speed through a voxel's face; then all turning is removed, and last the whole motion.
"""

import math

import numpy as np

from hapticdb.kernels._jit import (
    FLOAT,
    INT,
    INTS,
    INTS2,
    entry,
    inlined,
    leaf,
    record_of,
)
from hapticdb.kernels.hand.anchors import (
    AFTER,
    ANCHOR,
    BEFORE,
    NO_ANCHOR,
    anchor_of,
    lever_of,
    may_enter,
    outward,
    settle_anchors,
    voxel_under,
)
from hapticdb.kernels.hand.body import BODY, is_finite, is_somewhere, place_lost
from hapticdb.kernels.large.budget import Awake, tool_frame
from hapticdb.kernels.law import TangentPlaneLaw
from hapticdb.kernels.records import RESULTS, SERVO
from hapticdb.kernels.resident.cells import (
    CELLS,
    CLUSTERS,
    CONTACTS,
    DEEPEST,
    HITS,
    PLACE,
    READER_STRIDE,
    REVISION,
    UNKNOWNS,
    WRENCH,
    begin_frame,
    end_frame,
)
from hapticdb.kernels.rigid import pose_of_quaternion, product, quaternion_by, turn, turn_of

IS_HELD, IS_FADING, IS_DROPPED, IS_CUT, IS_STOPPED = 1, 2, 8, 16, 32
"""Flags of a period: the last wrench was kept; the kept wrench falls or is zero; part of the period
was not simulated; a step was cut back; a step was not made."""

ATTEMPTS = 8
"""Times that a step is cut back before the tool stops: two along outward directions, three without
turning at the end. Larger: fewer steps are given up, and the worst frame takes longer."""
TURNING_ATTEMPTS = 5
"""Attempts in which the tool may still turn."""
FREE_STEP = 0.5
"""Longest step without hits, times the spring's angular frequency. Larger: fewer steps, less
precision; the motion stays stable."""
CONTACT_STIFFNESS = 10.0
"""Largest stiffness of all contacts of a frame, in stiffnesses of one contact: forces are averaged.
Larger: shorter steps while a point is a hit."""
RISE_FRAMES = 4
"""Fewest frames in which a wrench rises to its full size, so that it does not jump after a long
period. Larger: a slower rise."""


@leaf
def clamped(x, y, z, longest):
    """Vector (x, y, z), shortened to the length `longest` where it is longer."""
    length = math.sqrt(x * x + y * y + z * z)
    scale = longest / length if length > longest else 1.0
    return scale * x, scale * y, scale * z


@leaf
def pull_of(body, tool, hand, pose, center, size, hits):
    """Stretch and speed of the coupling -> displacement, turn, relative velocities, lever.

    Three numbers each, from tool to hand: m, rad, m/s, rad/s. The lever, m, goes from the handle's
    origin to its centre. While a point is a hit, displacement and turn are clamped, and the
    velocities are clamped until the damper pulls no harder than the spring can.
    """
    x, y, z = center[0], center[1], center[2]
    at, aim, moves, leads = hand.position, hand.quaternion, tool.velocity, hand.velocity
    turned = tool.quaternion
    hw, hx, hy, hz = aim[0], aim[1], aim[2], aim[3]
    # the handle's centre, by the quaternion: p + 2 q_v x (q_v x c + w c)
    ux, uy, uz = hy * z - hz * y + hw * x, hz * x - hx * z + hw * y, hx * y - hy * x + hw * z
    rx = x + 2.0 * (hy * uz - hz * uy)
    ry = y + 2.0 * (hz * ux - hx * uz)
    rz = z + 2.0 * (hx * uy - hy * ux)
    dx = at[0] + rx - (turn(pose[0, 0], pose[0, 1], pose[0, 2], x, y, z) + pose[0, 3])
    dy = at[1] + ry - (turn(pose[1, 0], pose[1, 1], pose[1, 2], x, y, z) + pose[1, 3])
    dz = at[2] + rz - (turn(pose[2, 0], pose[2, 1], pose[2, 2], x, y, z) + pose[2, 3])
    tx, ty, tz = turn_of(*product(hw, hx, hy, hz, turned[0], -turned[1], -turned[2], -turned[3]))
    wx, wy, wz = leads[3], leads[4], leads[5]
    vx = leads[0] + (wy * rz - wz * ry) - moves[0]
    vy = leads[1] + (wz * rx - wx * rz) - moves[1]
    vz = leads[2] + (wx * ry - wy * rx) - moves[2]
    wx, wy, wz = wx - moves[3], wy - moves[4], wz - moves[5]
    if hits > 0.0:
        way, angle = 0.5 * size, 0.5 * size / body.radius
        dx, dy, dz = clamped(dx, dy, dz, way)
        tx, ty, tz = clamped(tx, ty, tz, angle)
        vx, vy, vz = clamped(vx, vy, vz, way * body.spring / body.damping)
        wx, wy, wz = clamped(wx, wy, wz, angle * body.turn_spring / body.turn_damping)
    return dx, dy, dz, tx, ty, tz, vx, vy, vz, wx, wy, wz, rx, ry, rz


@leaf
def push_hand(body, tool, hand, pose, center, size, wrench):
    """Unfaded wrench of the coupling on the hand, about the handle's origin, into wrench (6,)."""
    dx, dy, dz, tx, ty, tz, ux, uy, uz, wx, wy, wz, rx, ry, rz = pull_of(
        body, tool, hand, pose, center, size, 1.0
    )
    fx = -(body.spring * dx + body.damping * ux)
    fy = -(body.spring * dy + body.damping * uy)
    fz = -(body.spring * dz + body.damping * uz)
    wrench[0], wrench[1], wrench[2] = fx, fy, fz
    # the wrench acts at the handle's origin, the spring pulls at its centre
    wrench[3] = ry * fz - rz * fy - (body.turn_spring * tx + body.turn_damping * wx)
    wrench[4] = rz * fx - rx * fz - (body.turn_spring * ty + body.turn_damping * wy)
    wrench[5] = rx * fy - ry * fx - (body.turn_spring * tz + body.turn_damping * wz)


@leaf
def faded_of(body, seconds):
    """Share, 0 to 1, by which a wrench has faded that was kept for so many seconds."""
    return min(max((seconds - body.hold) / body.fade, 0.0), 1.0)


@leaf
def place_next(turned, center, pose, next_pose, step, vx, vy, vz, wx, wy, wz):
    """Pose after a step at constant velocities, into next_pose (4, 4) -> position, quaternion.

    turned (4,): unit quaternion of pose (4, 4); step in s, velocities of the centre, m/s and rad/s.
    """
    w, x, y, z = product(
        *quaternion_by(step * wx, step * wy, step * wz), turned[0], turned[1], turned[2], turned[3]
    )
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = scale * w, scale * x, scale * y, scale * z
    pose_of_quaternion(0.0, 0.0, 0.0, w, x, y, z, next_pose)
    cx, cy, cz = center[0], center[1], center[2]
    # position: the moved centre, minus the centre's lever in the turned frame
    px = turn(pose[0, 0], pose[0, 1], pose[0, 2], cx, cy, cz) + pose[0, 3] + step * vx
    py = turn(pose[1, 0], pose[1, 1], pose[1, 2], cx, cy, cz) + pose[1, 3] + step * vy
    pz = turn(pose[2, 0], pose[2, 1], pose[2, 2], cx, cy, cz) + pose[2, 3] + step * vz
    px -= turn(next_pose[0, 0], next_pose[0, 1], next_pose[0, 2], cx, cy, cz)
    py -= turn(next_pose[1, 0], next_pose[1, 1], next_pose[1, 2], cx, cy, cz)
    pz -= turn(next_pose[2, 0], next_pose[2, 1], next_pose[2, 2], cx, cy, cz)
    pose_of_quaternion(px, py, pz, w, x, y, z, next_pose)
    return px, py, pz, w, x, y, z


@inlined
def stop_along(gx, gy, gz, rx, ry, rz, lightness, slimness, v):
    """Change velocities v (6,) by an impulse at a point, so that it does not move against g.

    g: a unit vector; r: the point's lever; lightness: 1/m; slimness: 1/I, or 0 for a body that does
    not turn. A point that does not move against g gets no impulse.
    """
    vx, vy, vz, wx, wy, wz = v[0], v[1], v[2], v[3], v[4], v[5]
    ux, uy, uz = vx + wy * rz - wz * ry, vy + wz * rx - wx * rz, vz + wx * ry - wy * rx
    lacking = 0.0 - (ux * gx + uy * gy + uz * gz)
    if lacking <= 0.0:
        return
    ax, ay, az = ry * gz - rz * gy, rz * gx - rx * gz, rx * gy - ry * gx
    impulse = lacking / (lightness + slimness * (ax * ax + ay * ay + az * az))
    push, twist = impulse * lightness, impulse * slimness
    v[0], v[1], v[2] = vx + push * gx, vy + push * gy, vz + push * gz
    v[3], v[4], v[5] = wx + twist * ax, wy + twist * ay, wz + twist * az


@leaf
def cut_back(
    keys, slots, words, which, points, center, place, body, met, n_hits, pose, next_pose, attempt, v
):
    """Remove from velocities v (6,) the motion of hits into forbidden voxels -> number of these.

    v is changed in place, point after point: each point starts from the v that the last one left.
    """
    side = np.int64(place.side)
    lightness = 1.0 / body.mass
    slimness = 1.0 / body.inertia if attempt < TURNING_ATTEMPTS else 0.0
    count = 0
    for m in range(n_hits):
        n = met[BEFORE, m]
        if met[ANCHOR, n] < 0:
            continue
        oi, oj, ok = voxel_under(points, n, pose, place)
        i, j, k = voxel_under(points, n, next_pose, place)
        if i == oi and j == oj and k == ok:
            continue
        ai, aj, ak = anchor_of(met[ANCHOR, n], oi, oj, ok)
        if may_enter(keys, slots, words, which, side, ai, aj, ak, i, j, k) != 0:
            continue  # the point may enter, or the voxel is unknown, which ends the step anyway
        count += 1
        rx, ry, rz = lever_of(points, n, pose, center)
        if attempt == TURNING_ATTEMPTS:
            v[3] = v[4] = v[5] = 0.0
        if attempt < 2:
            gx, gy, gz = outward(keys, slots, words, which, side, ai, aj, ak, oi, oj, ok)
            ux = v[0] + v[4] * rz - v[5] * ry
            uy = v[1] + v[5] * rx - v[3] * rz
            uz = v[2] + v[3] * ry - v[4] * rx
            if ux * gx + uy * gy + uz * gz < 0.0:
                stop_along(gx, gy, gz, rx, ry, rz, lightness, slimness, v)
                continue
        n_shut = 0
        for axis in range(3):
            di = i - oi if axis == 0 else 0
            dj = j - oj if axis == 1 else 0
            dk = k - ok if axis == 2 else 0
            if di == 0 and dj == 0 and dk == 0:
                continue
            if (
                may_enter(keys, slots, words, which, side, ai, aj, ak, oi + di, oj + dj, ok + dk)
                != 0
            ):
                continue
            n_shut += 1
            gx, gy, gz = -float(di), -float(dj), -float(dk)
            stop_along(gx, gy, gz, rx, ry, rz, lightness, slimness, v)
        if n_shut == 0:  # only the way across an edge or a corner is shut: stop along that way
            gx, gy, gz = float(oi - i), float(oj - j), float(ok - k)
            length = math.sqrt(gx * gx + gy * gy + gz * gz)
            stop_along(gx / length, gy / length, gz / length, rx, ry, rz, lightness, slimness, v)
    return count


@leaf
def longest_step(speed, acceleration, way):
    """Seconds in which a point of that speed and acceleration goes at most `way` metres."""
    return 2.0 * way / (speed + math.sqrt(speed * speed + 4.0 * acceleration * way) + 1e-300)


@leaf
def length_of(x, y, z):
    """Euclidean length."""
    return math.sqrt(x * x + y * y + z * z)


@leaf
def slow_down(velocity, radius, fastest):
    """Scale a velocity (6,) down until no point at that radius is faster than `fastest`, m/s."""
    speed = length_of(velocity[0], velocity[1], velocity[2])
    speed += radius * length_of(velocity[3], velocity[4], velocity[5])
    if speed > fastest:
        for n in range(6):
            velocity[n] *= fastest / speed


@leaf
def move_body(watch, cells, reader, shell, place, body, servo_record, dt, met, missed):
    """`advance`; watch: an `Awake` or an `Asleep`, which says how frames skip points."""
    # loops instead of slices: one assignment to a slice costs a second of compile time
    which = begin_frame(cells, reader)
    version = cells.readers[reader * READER_STRIDE]
    points, center = shell.points, shell.center
    keys, slots, words = cells.keys, cells.slots, cells.words
    law = TangentPlaneLaw(body.stiffness)
    servo = servo_record[()]
    tool, hand, sent = servo.tool, servo.hand, servo.sent
    position, turned, velocity, kept = tool.position, tool.quaternion, tool.velocity, tool.kept
    pose, next_pose = tool.pose, tool.tried_pose
    frame, next_frame, box = tool.felt, tool.tried_felt, tool.loose
    reach = body.radius / place.size
    v = sent.wrench  # velocities of the step that is tried; the wrench comes last
    next_met = met[AFTER]
    flags = 0
    n_steps = 0
    n_unknown = np.int64(0)
    is_hand = is_somewhere(hand)
    is_held = hand.is_stale or not is_hand
    place_lost(tool, hand, is_hand)
    if not is_held and tool.version != version:
        is_first = tool.version == 0
        pose_of_quaternion(
            position[0], position[1], position[2], turned[0], turned[1], turned[2], turned[3], pose
        )
        tool_frame(watch, cells, which, shell, pose, place, law, next_met, missed, next_frame)
        n_unknown = np.int64(next_frame[UNKNOWNS])
        if n_unknown == 0:
            if is_first:
                for n in range(met.shape[1]):
                    met[ANCHOR, n] = NO_ANCHOR
            n_before = np.int64(0) if is_first else np.int64(frame[HITS])
            n_after = np.int64(next_frame[HITS])
            settle_anchors(
                keys, slots, words, which, points, center, place, met, n_before, n_after,
                pose, pose, np.bool_(True), box, reach,
            )  # fmt: skip
            for n in range(RESULTS):
                frame[n] = next_frame[n]
            tool.version = version
    left = dt if dt > 0.0 and not is_held and n_unknown == 0 else 0.0
    levers = 1.0 / body.mass + body.radius * body.radius / body.inertia
    rate = body.spring / body.mass
    free_step = FREE_STEP / math.sqrt(rate)
    contact_step = 1.0 / math.sqrt(rate + CONTACT_STIFFNESS * body.stiffness * levers)
    way = 0.5 * place.size
    while left > 0.0:
        if n_steps >= body.most_substeps:
            flags |= IS_DROPPED
            # else one absurd hand pose leaves a speed that needs too short steps to brake
            slow_down(velocity, body.radius, body.most_substeps * way / dt)
            break
        hits = frame[HITS]
        push = frame[WRENCH : WRENCH + 6]
        dx, dy, dz, tx, ty, tz, ux, uy, uz, wx, wy, wz, _, _, _ = pull_of(
            body, tool, hand, pose, center, place.size, hits
        )
        ax = (body.spring * dx + body.damping * ux + push[0]) / body.mass
        ay = (body.spring * dy + body.damping * uy + push[1]) / body.mass
        az = (body.spring * dz + body.damping * uz + push[2]) / body.mass
        bx = (body.turn_spring * tx + body.turn_damping * wx + push[3]) / body.inertia
        by = (body.turn_spring * ty + body.turn_damping * wy + push[4]) / body.inertia
        bz = (body.turn_spring * tz + body.turn_damping * wz + push[5]) / body.inertia
        speed = length_of(velocity[0], velocity[1], velocity[2])
        speed += body.radius * length_of(velocity[3], velocity[4], velocity[5])
        gain = length_of(ax, ay, az) + body.radius * length_of(bx, by, bz)
        step = min(longest_step(speed, gain, way), contact_step if hits > 0.0 else free_step)
        # np.ceil stays a float: a count above the largest int64 must not become negative
        step = left / np.ceil(left / step) if step < left else left
        n_steps += 1
        # the damper is implicit: it is stable for every length of step
        share = step / (1.0 + step * body.damping / body.mass)
        turn_share = step / (1.0 + step * body.turn_damping / body.inertia)
        v[0] = velocity[0] + share * ax
        v[1] = velocity[1] + share * ay
        v[2] = velocity[2] + share * az
        v[3] = velocity[3] + turn_share * bx
        v[4] = velocity[4] + turn_share * by
        v[5] = velocity[5] + turn_share * bz
        n_hits = np.int64(hits)
        is_shut = True
        px, py, pz, qw, qx, qy, qz = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
        for attempt in range(ATTEMPTS + 1):
            fast = step * (length_of(v[0], v[1], v[2]) + body.radius * length_of(v[3], v[4], v[5]))
            if fast > way:
                for axis in range(6):
                    v[axis] *= way / fast
            px, py, pz, qw, qx, qy, qz = place_next(
                turned, center, pose, next_pose, step, v[0], v[1], v[2], v[3], v[4], v[5]
            )
            if n_hits == 0:
                is_shut = False
                break
            if (
                cut_back(
                    keys,
                    slots,
                    words,
                    which,
                    points,
                    center,
                    place,
                    body,
                    met,
                    n_hits,
                    pose,
                    next_pose,
                    attempt,
                    v,
                )
                == 0
            ):
                is_shut = False
                break
            flags |= IS_CUT
        left -= step
        if is_shut:
            flags |= IS_STOPPED
            for n in range(6):
                velocity[n] = 0.0
            continue
        tool_frame(watch, cells, which, shell, next_pose, place, law, next_met, missed, next_frame)
        n_unknown = np.int64(next_frame[UNKNOWNS])
        if n_unknown > 0:
            break
        n_after = np.int64(next_frame[HITS])
        position[0], position[1], position[2] = px, py, pz
        turned[0], turned[1], turned[2], turned[3] = qw, qx, qy, qz
        for axis in range(6):
            velocity[axis] = v[axis]
        settle_anchors(
            keys, slots, words, which, points, center, place, met, n_hits, n_after,
            pose, next_pose, np.bool_(False), box, reach,
        )  # fmt: skip
        for row in range(4):
            for column in range(4):
                pose[row, column] = next_pose[row, column]
        for n in range(RESULTS):
            frame[n] = next_frame[n]
    revision = cells.control[REVISION + which]  # before end_frame: then the buffer may be reused
    end_frame(cells, reader)
    is_held = is_held or n_unknown > 0
    passed = max(dt, 0.0) / body.fade
    faded = 0.0
    if is_held:
        for n in range(6):
            velocity[n] = 0.0
        tool.held_for += max(dt, 0.0)
        faded = faded_of(body, tool.held_for)
        flags |= IS_HELD | (IS_FADING if faded > 0.0 else 0)
    else:
        tool.risen *= 1.0 - faded_of(body, tool.held_for)
        tool.held_for = 0.0
        if not hand.is_open:
            tool.risen = min(tool.risen + min(passed, 1.0 / RISE_FRAMES), 1.0)
        for n in range(6):
            kept[n] = 0.0
        if frame[HITS] > 0.0:
            push_hand(body, tool, hand, pose, center, place.size, kept)
            if not is_finite(kept):  # the next frame places the tool anew
                for n in range(6):
                    kept[n] = 0.0
    if hand.is_open:
        tool.risen = max(tool.risen - passed, 0.0)
    for axis in range(6):
        sent.wrench[axis] = (1.0 - faded) * tool.risen * kept[axis]
    sent.hits = np.int64(frame[HITS])
    sent.contacts = np.int64(frame[CONTACTS])
    sent.unknown = n_unknown
    sent.deepest = frame[DEEPEST]
    sent.n_steps = n_steps
    sent.marks = flags
    sent.revision = revision


@entry(CELLS, INT, CLUSTERS, PLACE, BODY, record_of(SERVO), FLOAT, INTS2, INTS)
def advance(cells, reader, shell, place, body, servo_record, dt, met, missed):
    """Move the tool for one period of dt seconds.

    servo_record () of SERVO: `tool` is updated, `hand` is read, `sent` is written. The caller keeps
    met (MET_ROWS, N) int64, rows as in `anchors`, and missed, as `felt` fills it, between periods.
    `tool.felt` is the result of `felt` at exactly the tool's position and quaternion, in the cells
    of one published version; its wrench is about the tool's centre of mass. `sent.wrench` is the
    wrench of the coupling on the hand, about the handle's origin; it is exactly zero while no point
    is a hit. Its force is at most k s, with the voxel size s: half from the spring, half from the
    damper. Likewise its torque about the centre is at most k r s, with the radius r.

    If a step would take points into unknown cells, the tool stays at rest before it. The wrench is
    kept for `hold` seconds, then falls to zero within `fade` seconds; `sent.unknown` and missed
    then belong to the pose that was tried. After that, and after the first frame, the wrench rises
    to its full size within `fade` seconds and at least RISE_FRAMES frames. While the clutch is open
    the wrench falls to zero, and the tool still follows the handle.

    While the hand is not finite, the tool and the wrench are held. A tool that is not finite is
    placed at the first finite hand, at rest.
    """
    watch = Awake(np.int64(0))
    move_body(watch, cells, reader, shell, place, body, servo_record, dt, met, missed)
