"""Virtual coupling: a rigid body between the hand and the shell, one period of the loop at a time.

The tool is a body of some mass and one moment of inertia. A spring and a damper pull it to the
handle, the contact wrench pushes it, and it moves by semi-implicit steps, the damper implicit. No
point moves more than half a voxel in a step.

That alone lets a fast tool through a thin sheet, so a step that a hit may not make (see `anchors`)
is cut back: what carries the point against the outward direction is taken away by an impulse; then
what carries it through a face; then all turning; then all of the motion.
"""

import math
from typing import NamedTuple

import numpy as np

from hapticdb.kernels._jit import FLOAT, FLOATS, INT, INTS, INTS2, entry, fields_of, inlined, leaf
from hapticdb.kernels.hand.anchors import (
    NO_ANCHOR,
    anchor_of,
    lever_of,
    may_enter,
    outward,
    settle_anchors,
    voxel_under,
)
from hapticdb.kernels.motion import pose_of_quaternion, product, quaternion_by, turn_of
from hapticdb.kernels.query.contact import turn
from hapticdb.kernels.resident.cells import (
    CELLS,
    CLUSTERS,
    CONTACTS,
    DEEPEST,
    HITS,
    PLACE,
    READER_STRIDE,
    RESULTS,
    REVISION,
    UNKNOWNS,
    begin_frame,
    end_frame,
    felt,
)

POSITION, QUATERNION, VELOCITY, TURNING, KEPT = 0, 3, 7, 10, 13
"""Where `state` has what: m and unit quaternion of the tool's frame, m/s of its centre of mass,
rad/s, and the wrench that the hand was to feel last, in full."""
HELD_FOR, FELT, _NEXT, _POSE, _NEXT_POSE, RISEN, _BOX = 19, 20, 21, 31, 47, 63, 64
"""Seconds for which the wrench is held; and, before the box of `settle_anchors`, the share of it
that is sent, 0 to 1."""
STATE = 70
"""Numbers of a state; zero but for position and quaternion at the start."""
HAND_VELOCITY, IS_STALE, IS_OPEN = 7, 13, 14
HAND = 15
"""Numbers of a hand: position, unit quaternion, velocity (6,) of the handle's frame, scene metres;
whether to hold as if all were unknown, and whether the clutch is open, 0 or 1."""
APPLIED, SUBSTEPS, FLAGS, OUT_REVISION = 0, 10, 11, 12
OUT = 13
"""Numbers of a result: the wrench for the device (6,), about the handle's origin; hits, contacts,
unknown points and deepest where `cells` has them in a frame's result; steps made, flags, the
database's revision."""
MET_ROWS = 3
"""Rows of `met`: the hits' indices, those of a frame that is tried, and each point's anchor."""

IS_HELD, IS_FADING, IS_DROPPED, IS_CUT, IS_STOPPED = 1, 2, 8, 16, 32
"""Flags: the wrench was kept; it is falling or gone; time was left over; a step was cut back; a
step was not made."""

ATTEMPTS = 8
"""To cut a step back: the first two along outward directions, the last three without turning."""
TURNING_ATTEMPTS = 5
FREE_STEP = 0.5
"""Longest step of free motion, times the spring's frequency: for precision, not for stability."""
CONTACT_STIFFNESS = 10.0
"""Contacts of a frame, averaged, are never stiffer than so many."""
RISE_FRAMES = 4
"""Frames, at least, in which a wrench rises: after a period that lasted long it must not jump."""


class Body(NamedTuple):
    """The tool as a body, and its coupling.

    mass in kg, inertia in kg m^2; spring and turn_spring in N/m and N m/rad, damping and
    turn_damping in N s/m and N m s/rad; radius, of the point farthest from the centre, m;
    stiffness of a contact, N/m; hold and fade in s; most_substeps of a period.
    """

    mass: float
    inertia: float
    spring: float
    damping: float
    turn_spring: float
    turn_damping: float
    radius: float
    stiffness: float
    hold: float
    fade: float
    most_substeps: int


BODY = fields_of(Body, *(FLOAT,) * 10, INT)


@leaf
def clamped(x, y, z, longest):
    """Vector, no longer than that."""
    length = math.sqrt(x * x + y * y + z * z)
    scale = longest / length if length > longest else 1.0
    return scale * x, scale * y, scale * z


@leaf
def pull_of(body, state, hand, pose, center, size, hits):
    """Spring and damper at a state -> displacement (3), turn (3), relative velocities (3), (3).

    And the lever (3) of the handle's centre about the handle's origin. While a point hits,
    displacement and turn are clamped, and the velocities so that the damper pulls no harder than
    the spring can.
    """
    x, y, z = center[0], center[1], center[2]
    hw, hx, hy, hz = hand[3], hand[4], hand[5], hand[6]
    # the handle's centre, by the quaternion: p + 2 q_v x (q_v x c + w c)
    ux, uy, uz = hy * z - hz * y + hw * x, hz * x - hx * z + hw * y, hx * y - hy * x + hw * z
    rx = x + 2.0 * (hy * uz - hz * uy)
    ry = y + 2.0 * (hz * ux - hx * uz)
    rz = z + 2.0 * (hx * uy - hy * ux)
    dx = hand[0] + rx - (turn(pose[0, 0], pose[0, 1], pose[0, 2], x, y, z) + pose[0, 3])
    dy = hand[1] + ry - (turn(pose[1, 0], pose[1, 1], pose[1, 2], x, y, z) + pose[1, 3])
    dz = hand[2] + rz - (turn(pose[2, 0], pose[2, 1], pose[2, 2], x, y, z) + pose[2, 3])
    tx, ty, tz = turn_of(*product(hw, hx, hy, hz, state[3], -state[4], -state[5], -state[6]))
    wx, wy, wz = hand[10], hand[11], hand[12]
    vx = hand[7] + (wy * rz - wz * ry) - state[7]
    vy = hand[8] + (wz * rx - wx * rz) - state[8]
    vz = hand[9] + (wx * ry - wy * rx) - state[9]
    wx, wy, wz = wx - state[10], wy - state[11], wz - state[12]
    if hits > 0.0:
        way, angle = 0.5 * size, 0.5 * size / body.radius
        dx, dy, dz = clamped(dx, dy, dz, way)
        tx, ty, tz = clamped(tx, ty, tz, angle)
        vx, vy, vz = clamped(vx, vy, vz, way * body.spring / body.damping)
        wx, wy, wz = clamped(wx, wy, wz, angle * body.turn_spring / body.turn_damping)
    return dx, dy, dz, tx, ty, tz, vx, vy, vz, wx, wy, wz, rx, ry, rz


@leaf
def push_hand(body, state, hand, pose, center, size, wrench):
    """What the coupling does to the hand about the handle's origin, in full, into wrench (6,)."""
    dx, dy, dz, tx, ty, tz, ux, uy, uz, wx, wy, wz, rx, ry, rz = pull_of(
        body, state, hand, pose, center, size, 1.0
    )
    fx = -(body.spring * dx + body.damping * ux)
    fy = -(body.spring * dy + body.damping * uy)
    fz = -(body.spring * dz + body.damping * uz)
    wrench[0], wrench[1], wrench[2] = fx, fy, fz
    # the hand is pushed at its origin, the spring pulls at the centre
    wrench[3] = ry * fz - rz * fy - (body.turn_spring * tx + body.turn_damping * wx)
    wrench[4] = rz * fx - rx * fz - (body.turn_spring * ty + body.turn_damping * wy)
    wrench[5] = rx * fy - ry * fx - (body.turn_spring * tz + body.turn_damping * wz)


@inlined
def is_finite(numbers, first, end):
    """Whether all of numbers[first:end] are."""
    count = 0
    for n in range(first, end):
        count += math.isfinite(numbers[n])
    return count == end - first


@leaf
def faded_of(body, seconds):
    """Share of the wrench that is gone when it was held for so long."""
    return min(max((seconds - body.hold) / body.fade, 0.0), 1.0)


@leaf
def place_next(state, center, pose, next_pose, step, vx, vy, vz, wx, wy, wz):
    """Move the frame for a step: into next_pose -> position, quaternion."""
    w, x, y, z = product(
        *quaternion_by(step * wx, step * wy, step * wz), state[3], state[4], state[5], state[6]
    )
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = scale * w, scale * x, scale * y, scale * z
    pose_of_quaternion(0.0, 0.0, 0.0, w, x, y, z, next_pose)
    cx, cy, cz = center[0], center[1], center[2]
    # the centre's old place and way, less its new place in a frame at the origin
    px = turn(pose[0, 0], pose[0, 1], pose[0, 2], cx, cy, cz) + pose[0, 3] + step * vx
    py = turn(pose[1, 0], pose[1, 1], pose[1, 2], cx, cy, cz) + pose[1, 3] + step * vy
    pz = turn(pose[2, 0], pose[2, 1], pose[2, 2], cx, cy, cz) + pose[2, 3] + step * vz
    px -= turn(next_pose[0, 0], next_pose[0, 1], next_pose[0, 2], cx, cy, cz)
    py -= turn(next_pose[1, 0], next_pose[1, 1], next_pose[1, 2], cx, cy, cz)
    pz -= turn(next_pose[2, 0], next_pose[2, 1], next_pose[2, 2], cx, cy, cz)
    pose_of_quaternion(px, py, pz, w, x, y, z, next_pose)
    return px, py, pz, w, x, y, z


@leaf
def stopped_along(gx, gy, gz, floor, rx, ry, rz, vx, vy, vz, wx, wy, wz, lightness, slimness):
    """Velocities after an impulse along a unit g that makes a point's speed there `floor`.

    The point is at lever r; lightness 1/m, slimness 1/I, 0 for a body that does not turn. Nothing
    happens to a point that is as fast already.
    """
    ux, uy, uz = vx + wy * rz - wz * ry, vy + wz * rx - wx * rz, vz + wx * ry - wy * rx
    lacking = floor - (ux * gx + uy * gy + uz * gz)
    if lacking <= 0.0:
        return vx, vy, vz, wx, wy, wz
    ax, ay, az = ry * gz - rz * gy, rz * gx - rx * gz, rx * gy - ry * gx
    impulse = lacking / (lightness + slimness * (ax * ax + ay * ay + az * az))
    push, twist = impulse * lightness, impulse * slimness
    return (
        vx + push * gx, vy + push * gy, vz + push * gz,
        wx + twist * ax, wy + twist * ay, wz + twist * az,
    )  # fmt: skip


@leaf
def cut_back(
    keys, slots, words, which, points, center, place, body, met, n_hits, pose, next_pose, attempt, v
):
    """Take from velocities v (6,) what carries hits where they may not go; returns how many are.

    v is changed in place, point after point, each seeing what is left by those before it.
    """
    side = np.int64(place.side)
    lightness = 1.0 / body.mass
    slimness = 1.0 / body.inertia if attempt < TURNING_ATTEMPTS else 0.0
    count = 0
    for m in range(n_hits):
        n = met[0, m]
        if met[2, n] < 0:
            continue
        oi, oj, ok = voxel_under(points, n, pose, place)
        i, j, k = voxel_under(points, n, next_pose, place)
        if i == oi and j == oj and k == ok:
            continue
        ai, aj, ak = anchor_of(met[2, n], oi, oj, ok)
        if may_enter(keys, slots, words, which, side, ai, aj, ak, i, j, k) != 0:
            continue  # what is unknown ends the step anyway
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
                v[0], v[1], v[2], v[3], v[4], v[5] = stopped_along(
                    gx, gy, gz, 0.0, rx, ry, rz, v[0], v[1], v[2], v[3], v[4], v[5],
                    lightness, slimness,
                )  # fmt: skip
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
            v[0], v[1], v[2], v[3], v[4], v[5] = stopped_along(
                -float(di), -float(dj), -float(dk), 0.0, rx, ry, rz,
                v[0], v[1], v[2], v[3], v[4], v[5], lightness, slimness,
            )  # fmt: skip
        if n_shut == 0:  # only the way across an edge or a corner is shut: not into it, then
            di, dj, dk = float(oi - i), float(oj - j), float(ok - k)
            length = math.sqrt(di * di + dj * dj + dk * dk)
            v[0], v[1], v[2], v[3], v[4], v[5] = stopped_along(
                di / length, dj / length, dk / length, 0.0, rx, ry, rz,
                v[0], v[1], v[2], v[3], v[4], v[5], lightness, slimness,
            )  # fmt: skip
    return count


@leaf
def longest_step(speed, acceleration, way):
    """Seconds in which a point of that speed, accelerated for as long, goes no farther than way."""
    return 2.0 * way / (speed + math.sqrt(speed * speed + 4.0 * acceleration * way) + 1e-300)


@leaf
def length_of(x, y, z):
    """Euclidean length."""
    return math.sqrt(x * x + y * y + z * z)


@leaf
def slow_down(state, radius, fastest):
    """Take from a state's velocities what would make a point faster than that, m/s."""
    speed = length_of(state[7], state[8], state[9])
    speed += radius * length_of(state[10], state[11], state[12])
    if speed > fastest:
        for n in range(7, 13):
            state[n] *= fastest / speed


@entry(CELLS, INT, CLUSTERS, PLACE, BODY, FLOATS, FLOATS, FLOAT, INTS2, INTS, FLOATS, FLOATS)
def advance(cells, reader, shell, place, body, state, hand, dt, met, missed, frame, out):
    """Move the tool for one period of dt seconds.

    state (STATE,), hand (HAND,) and out (OUT,) as above; met (MET_ROWS, N) int64 and missed as
    `felt` has them, the frame's hits in row 0 of met; frame (RESULTS,) is what `felt` says at
    exactly the pose state[0:7], among the cells of one published version, its wrench about the
    tool's centre of mass. out's wrench is what the coupling does to the hand, about the handle's
    origin, exactly zero while no point hits. Its force is k s at most, s the voxels' size: half
    from the spring, half from the damper; so is its torque about the centre, k r s of the radius r.

    Where the tool would meet unknown cells it stays, still, and the wrench is kept for `hold`
    seconds, then falls to zero within `fade`; out and missed then tell of the pose that was tried.
    After that, and from the first frame on, it rises to its full size within `fade`, and in
    RISE_FRAMES frames at least; while the clutch is open it falls, and the tool goes on.

    With a hand that is not finite all is held; a state that is not is placed anew, at rest, at the
    first hand that is finite.
    """
    # loops, not slices: a slice that is assigned costs a second of compile time
    which = begin_frame(cells, reader)
    version = float(cells.readers[reader * READER_STRIDE])
    points, center = shell.points, shell.center
    keys, slots, words = cells.keys, cells.slots, cells.words
    pose = state[_POSE : _POSE + 16].reshape(4, 4)
    next_pose = state[_NEXT_POSE : _NEXT_POSE + 16].reshape(4, 4)
    next_frame = state[_NEXT : _NEXT + RESULTS]
    box = state[_BOX : _BOX + 6]
    reach = body.radius / place.size
    v = out[0:6]  # of the step that is tried, until the wrench is known
    next_met = met[1]
    flags = 0
    n_steps = 0
    n_unknown = np.int64(0)
    is_hand = is_finite(hand, 0, HAND)
    is_held = hand[IS_STALE] != 0.0 or not is_hand
    if not is_finite(state, 0, FELT):
        for n in range(VELOCITY, STATE):
            state[n] = 0.0
        for n in range(RESULTS):
            frame[n] = 0.0
        if is_hand:
            for n in range(VELOCITY):
                state[n] = hand[n]
    if not is_held and state[FELT] != version:
        is_first = state[FELT] == 0.0
        pose_of_quaternion(
            state[0], state[1], state[2], state[3], state[4], state[5], state[6], pose
        )
        felt(cells, which, shell, pose, place, body.stiffness, next_met, missed, next_frame)
        n_unknown = np.int64(next_frame[UNKNOWNS])
        if n_unknown == 0:
            if is_first:
                for n in range(met.shape[1]):
                    met[2, n] = NO_ANCHOR
            n_before = np.int64(0) if is_first else np.int64(frame[HITS])
            n_after = np.int64(next_frame[HITS])
            settle_anchors(
                keys, slots, words, which, points, center, place, met, n_before, n_after,
                pose, pose, np.bool_(True), box, reach,
            )  # fmt: skip
            for n in range(RESULTS):
                frame[n] = next_frame[n]
            state[FELT] = version
    left = dt if dt > 0.0 and not is_held and n_unknown == 0 else 0.0
    levers = 1.0 / body.mass + body.radius * body.radius / body.inertia
    rate = body.spring / body.mass
    free_step = FREE_STEP / math.sqrt(rate)
    contact_step = 1.0 / math.sqrt(rate + CONTACT_STIFFNESS * body.stiffness * levers)
    way = 0.5 * place.size
    while left > 0.0:
        if n_steps >= body.most_substeps:
            flags |= IS_DROPPED
            # else one absurd hand would leave a speed whose steps are too short to brake it
            slow_down(state, body.radius, body.most_substeps * way / dt)
            break
        hits = frame[HITS]
        dx, dy, dz, tx, ty, tz, ux, uy, uz, wx, wy, wz, _, _, _ = pull_of(
            body, state, hand, pose, center, place.size, hits
        )
        ax = (body.spring * dx + body.damping * ux + frame[0]) / body.mass
        ay = (body.spring * dy + body.damping * uy + frame[1]) / body.mass
        az = (body.spring * dz + body.damping * uz + frame[2]) / body.mass
        bx = (body.turn_spring * tx + body.turn_damping * wx + frame[3]) / body.inertia
        by = (body.turn_spring * ty + body.turn_damping * wy + frame[4]) / body.inertia
        bz = (body.turn_spring * tz + body.turn_damping * wz + frame[5]) / body.inertia
        speed = length_of(state[7], state[8], state[9])
        speed += body.radius * length_of(state[10], state[11], state[12])
        gain = length_of(ax, ay, az) + body.radius * length_of(bx, by, bz)
        step = min(longest_step(speed, gain, way), contact_step if hits > 0.0 else free_step)
        # numpy's, a float: more steps than an integer holds are none of a negative length
        step = left / np.ceil(left / step) if step < left else left
        n_steps += 1
        # the damper implicit: no step is too long for it
        share = step / (1.0 + step * body.damping / body.mass)
        turn_share = step / (1.0 + step * body.turn_damping / body.inertia)
        v[0], v[1], v[2] = state[7] + share * ax, state[8] + share * ay, state[9] + share * az
        v[3] = state[10] + turn_share * bx
        v[4] = state[11] + turn_share * by
        v[5] = state[12] + turn_share * bz
        n_hits = np.int64(hits)
        is_shut = True
        px, py, pz, qw, qx, qy, qz = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
        for attempt in range(ATTEMPTS + 1):
            fast = step * (length_of(v[0], v[1], v[2]) + body.radius * length_of(v[3], v[4], v[5]))
            if fast > way:
                for axis in range(6):
                    v[axis] *= way / fast
            px, py, pz, qw, qx, qy, qz = place_next(
                state, center, pose, next_pose, step, v[0], v[1], v[2], v[3], v[4], v[5]
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
            for n in range(VELOCITY, KEPT):
                state[n] = 0.0
            continue
        felt(cells, which, shell, next_pose, place, body.stiffness, next_met, missed, next_frame)
        n_unknown = np.int64(next_frame[UNKNOWNS])
        if n_unknown > 0:
            break
        n_after = np.int64(next_frame[HITS])
        state[0], state[1], state[2] = px, py, pz
        state[3], state[4], state[5], state[6] = qw, qx, qy, qz
        for axis in range(6):
            state[VELOCITY + axis] = v[axis]
        settle_anchors(
            keys, slots, words, which, points, center, place, met, n_hits, n_after,
            pose, next_pose, np.bool_(False), box, reach,
        )  # fmt: skip
        for n in range(16):
            state[_POSE + n] = state[_NEXT_POSE + n]
        for n in range(RESULTS):
            frame[n] = next_frame[n]
    revision = cells.control[REVISION + which]  # of what was read: later the buffer is another's
    end_frame(cells, reader)
    is_held = is_held or n_unknown > 0
    passed = max(dt, 0.0) / body.fade
    kept = state[KEPT : KEPT + 6]
    faded = 0.0
    if is_held:
        for n in range(VELOCITY, KEPT):
            state[n] = 0.0
        state[HELD_FOR] += max(dt, 0.0)
        faded = faded_of(body, state[HELD_FOR])
        flags |= IS_HELD | (IS_FADING if faded > 0.0 else 0)
    else:
        state[RISEN] *= 1.0 - faded_of(body, state[HELD_FOR])
        state[HELD_FOR] = 0.0
        if hand[IS_OPEN] == 0.0:
            state[RISEN] = min(state[RISEN] + min(passed, 1.0 / RISE_FRAMES), 1.0)
        for n in range(6):
            kept[n] = 0.0
        if frame[HITS] > 0.0:
            push_hand(body, state, hand, pose, center, place.size, kept)
            if not is_finite(kept, 0, 6):  # the next frame heals the state
                for n in range(6):
                    kept[n] = 0.0
    if hand[IS_OPEN] != 0.0:
        state[RISEN] = max(state[RISEN] - passed, 0.0)
    for axis in range(6):
        out[axis] = (1.0 - faded) * state[RISEN] * kept[axis]
    out[HITS] = frame[HITS]
    out[CONTACTS] = frame[CONTACTS]
    out[UNKNOWNS] = n_unknown
    out[DEEPEST] = frame[DEEPEST]
    out[SUBSTEPS] = n_steps
    out[FLAGS] = flags
    out[OUT_REVISION] = revision
