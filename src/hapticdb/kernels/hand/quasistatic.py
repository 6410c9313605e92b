"""Virtual coupling with contact constraints, quasi-static: spring and contacts balance each period.

The tool has a pose and no velocity. Each period moves it to the minimum of the energy of the spring
to the hand and of the contacts with the distance field (`step`), by Gauss-Newton steps under
conservative advancement (`advancement`). The force on the hand is the spring's. So the stiffness at
the hand never exceeds the spring's, for any voxel size, number of points and contact stiffness.

It needs resident cells with distances.
"""

import math

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.force_law import NO_WRENCH
from hapticdb.kernels.hand.advancement import (
    MOST_QUERIES,
    advance_step,
    place_on_step,
    set_pose,
    step_bound,
)
from hapticdb.kernels.hand.device_spring import (
    BEYOND_CAP,
    STOPPING,
    at_device,
    contact_stiffness,
    lever_in_hand,
    measure_pull,
    wrench_of,
)
from hapticdb.kernels.hand.fading import (
    IS_CUT,
    IS_DROPPED,
    is_finite,
    is_valid_pose,
    place_lost,
    send,
    set_result,
)
from hapticdb.kernels.hand.gauss_newton import solve_step
from hapticdb.kernels.hand.near_points import (
    FLOOR,
    NOT_KNOWN,
    OPEN,
    SHUT,
    depth_of,
    fix_onsets,
    least_distance,
    query_anew,
    query_proximity,
    reset_points,
    settle,
    take_more_points,
)
from hapticdb.kernels.hand.oscillation_guard import (
    MOST_CHANGE,
    WINDOW,
    begin_steady,
    guard_stiffness,
    hand_speed,
    remember_hand,
    soften_change,
)
from hapticdb.kernels.rigid import numbers_of, pose_of_quaternion

IS_INSIDE, IS_SOFTER, IS_SNAPPING, IS_ANEW = 64, 128, 256, 512
"""Marks of a period, besides those of `fading`: tool inside an obstacle, without contacts;
stiffness lowered by the guard; change of the force limited; cells changed."""

STEPS = 3
"""Most Gauss-Newton steps of a period. Larger: sharper corners are followed in one period, and the
worst period takes longer."""
ROUNDS = 6
"""Most solutions of a step's equations until the contact set is stable. Larger: the set is right
more often in corners, and the worst period takes longer."""
SETTLED = 5e-3
"""Steps in contact with shorter paths of all points, voxels, are not done: the force is that at
their end. Larger: fewer queries, and the tool's pose and the force's direction are less exact."""
BENT_FROM = 2
"""Steps of a period before the surface's curvature enters the equations, until it is flat. Larger:
less computing, and more steps in corners."""
SHORT_CUT = 0.1
"""If less than this share of a step was done, the next one is braked. Larger: braked more often."""
SUNK = 0.02
"""Least approach of a surface, voxels, by a new version of the cells. A distance also below FLOOR -
SUNK means an object put upon the tool."""


@leaf
def has_moved(tool, follower):
    """Whether the tool is not at the pose of its near points."""
    at, count = numbers_of(tool), 0
    # exact comparison: any other number is a reset by the caller, and so is NaN
    for n in range(7):
        count += at[n] != follower.queried_at[n]
    return count > 0


@leaf
def _meet_change(query):
    """Compare the last query with the one before, at the same pose in older cells.

    Contact with an approached surface begins at the present distance, so no force jumps. Returns
    whether a point is now inside an object.
    """
    # before `settle`: the tried row is new, while `kept` still has the last distances
    near = query.near[1 - query.follower.side]
    is_sunk = False
    for m in range(query.follower.n_tried):
        point, u = query.kept[near[m].point], near[m].u
        if u < point.u - SUNK:
            point.onset = min(point.onset, u)
            is_sunk = is_sunk or u < FLOOR - SUNK
    return is_sunk


@leaf
def _query_here(query, tool):
    """Query the tool's pose, at the start or in new cells; False with points in unknown cells."""
    follower, is_first = query.follower, tool.version == 0
    if is_first:
        reset_points(query)
        begin_steady(follower)
        follower.is_loose = follower.is_braked = follower.is_bent = False
    else:
        query_anew(query)
    pose_of_quaternion(*numbers_of(tool), tool.tried_pose)
    found = query_proximity(query, tool.tried_pose, 0.0, np.bool_(False))
    if found == NOT_KNOWN:
        return False
    # distances in two versions compare at one pose only
    is_sunk = not has_moved(tool, follower) and _meet_change(query)
    settle(query)
    set_pose(tool, follower, numbers_of(tool))
    if is_first:
        fix_onsets(query)
        is_sunk = least_distance(query) < FLOOR
    follower.is_loose = follower.is_loose or is_sunk  # only `_follow_inside` ends it
    return True


@leaf
def _query_more(query, tool):
    """Query the tool's pose, with contacts merged before -> OPEN or NOT_KNOWN.

    Contact of a returning point begins at its present distance, so no force jumps. A point nearer
    than FLOOR gets no nearer to a surface.
    """
    pose_of_quaternion(*numbers_of(tool), tool.tried_pose)
    found = query_proximity(query, tool.tried_pose, query.follower.astray, np.bool_(False))
    if found == OPEN:
        _meet_change(query)
        settle(query)
    return found


@leaf
def _follow_inside(query, spring, tool, hand):
    """Move a tool inside an obstacle to the hand -> OPEN or NOT_KNOWN.

    Contacts begin once no point is nearer than FLOOR to a surface.
    """
    follower, center = query.follower, query.shell.center
    measure_pull(spring, tool, hand, tool.pose, center, follower)
    # the whole stretch at once, without advancement: inside there is no side to protect
    for axis in range(6):
        follower.step[axis] = follower.pull[axis]
    path_length = step_bound(follower, spring.radius, query.grid.size)
    at = place_on_step(tool, center, follower, 1.0)
    found = query_proximity(query, tool.tried_pose, follower.astray + path_length, np.bool_(False))
    follower.astray = path_length  # reset by `settle`, unless the pose is refused
    if found == OPEN:
        settle(query)
        set_pose(tool, follower, at)
        follower.n_active = 0
        if least_distance(query) >= FLOOR:
            follower.is_loose = False
            fix_onsets(query)
    return found


@leaf
def follow(query, spring, tool, hand):
    """Move the tool to the balance of spring and contacts; return the last query's result.

    SHUT : the tool is stopped by a surface, or the period has no queries left.
    """
    follower, size, most = query.follower, query.grid.size, BEYOND_CAP * spring.cap
    stiffness = contact_stiffness(spring, size)
    found = OPEN
    # the last turn only measures and solves: pull and contact set belong to the final pose
    for n in range(STEPS + 1):
        measure_pull(spring, tool, hand, tool.pose, query.shell.center, follower)
        brake = STOPPING * most / size if follower.is_braked else 0.0
        turn_brake = brake * spring.radius * spring.radius  # the same force at the farthest point
        solve_step(query, stiffness, brake, turn_brake, ROUNDS)
        path_length = step_bound(follower, spring.radius, size)
        # read by the next query: curvatures are computed together with the distances
        follower.is_bent = n >= BENT_FROM or follower.n_bends > 0
        if n == STEPS or follower.n_queries >= MOST_QUERIES or path_length == 0.0:
            break
        if path_length < SETTLED and follower.n_active > 0:
            # the pull at the end of the omitted step, to first order
            for axis in range(6):
                follower.pull[axis] -= follower.step[axis]
            break
        done, found = advance_step(query, spring.radius, tool)
        if found == NOT_KNOWN:
            break
        if done == 1.0 and follower.n_active == 0 and not follower.is_braked:
            # free motion ends at the hand bit for bit: rounding leaves no residual force
            set_pose(tool, follower, numbers_of(hand))
        follower.is_braked = done < SHORT_CUT
    return found


@leaf
def _record_contacts(query, stiffness, felt):
    """Write points to query.contacts, and wrench on the tool and counts of contacts to `felt`.

    Hits are the near points in the contact set or with a force; contacts are those with a force.
    """
    follower, near, deepest = query.follower, query.near[query.follower.side], 0.0
    n_hits = n_contacts = 0
    set_result(felt, NO_WRENCH, 0, 0, 0, 0.0)
    if not follower.is_loose:
        for m in range(follower.n_near):
            one = near[m]
            depth = depth_of(query, one)
            if depth <= 0.0 and not one.is_active:
                continue
            query.contacts[n_hits] = one.point
            n_hits += 1
            if depth > 0.0:
                n_contacts += 1
                deepest = max(deepest, depth)
                for axis in range(3):
                    force = stiffness * depth
                    felt.wrench[axis] += force * one.along[axis]
                    felt.wrench[3 + axis] += force * one.about[axis]
    felt.hits, felt.contacts, felt.deepest = n_hits, n_contacts, deepest


@leaf
def _push_hand(spring, tool, hand, center, follower, is_in_contact, dt, wrench):
    """Wrench on the hand at the device, about the handle's origin, into wrench (6,) -> marks."""
    for axis in range(6):
        wrench[axis] = 0.0
    force = 0.0
    if is_in_contact:
        wrench[0], wrench[1], wrench[2], wrench[3], wrench[4], wrench[5] = at_device(
            spring, hand, center, *wrench_of(follower, spring.cap, spring.turn_cap * spring.scale)
        )
        x, y, z = wrench[0], wrench[1], wrench[2]
        force = math.sqrt(x * x + y * y + z * z)
    # the guard counts the spring's force: the damper's own chatter would be a reversal
    flags = IS_SOFTER if guard_stiffness(follower, force, dt) else 0
    if force > 0.0:
        speed = hand_speed(follower, hand, x / force, y / force, z / force) / spring.scale
        # the damper neither reverses the force nor more than doubles it
        damped = force + min(max(-spring.damping * speed, -force), force)
        damped = min(damped, spring.cap)
        for axis in range(3):
            wrench[axis] *= damped / force
    rx, ry, rz = lever_in_hand(hand, center)
    last, at = follower.last_hand, hand.position
    x, y, z = at[0] + rx - last[0], at[1] + ry - last[1], at[2] + rz - last[2]
    last[0], last[1], last[2] = at[0] + rx, at[1] + ry, at[2] + rz
    path_length = math.sqrt(x * x + y * y + z * z) / spring.scale
    # a hand that moves against a still tool changes the force by spring and damper: no snap
    allowed = MOST_CHANGE * dt + (spring.stiffness + spring.damping / WINDOW) * path_length
    if soften_change(tool.kept, wrench, allowed):
        flags |= IS_SNAPPING
    return flags


@leaf
def finish(query, spring, servo, is_held, found, dt):
    """Send the period's wrench and marks; contacts into `tool.felt`."""
    flags, tool, hand, wrench = 0, servo.tool, servo.hand, servo.sent.wrench
    follower = query.follower
    if is_held:
        follower.n_trail = 0  # a speed across a gap has no meaning
    else:
        remember_hand(follower, hand, dt)
        is_over = follower.n_queries >= MOST_QUERIES
        # SHUT for want of queries is no obstacle
        is_in_contact = follower.n_active > 0 or (found == SHUT and not is_over)
        is_in_contact = is_in_contact and not follower.is_loose
        flags |= _push_hand(
            spring, tool, hand, query.shell.center, follower, is_in_contact, dt, wrench
        )
        for n in range(6):
            # all six or none: `kept` is sent again in held periods
            tool.kept[n] = wrench[n] if is_finite(wrench) else 0.0
        _record_contacts(query, contact_stiffness(spring, query.grid.size), tool.felt)
        flags |= IS_DROPPED if is_over else (IS_CUT if found == SHUT else 0)
        flags |= IS_INSIDE if follower.is_loose else 0
    send(spring, servo, is_held, flags, dt)


@leaf
def _move_tool(query, version, spring, tool, hand):
    """Move the tool after the hand, in a version of the cells -> result of the last query."""
    found = OPEN
    # new cells or a reset pose void every `due` and near point
    if tool.version != version or has_moved(tool, query.follower):
        if not _query_here(query, tool):
            return NOT_KNOWN
        tool.version = version
    elif take_more_points(query):
        found = _query_more(query, tool)
    if found != OPEN:
        return found
    if query.follower.is_loose:
        return _follow_inside(query, spring, tool, hand)
    return follow(query, spring, tool, hand)


@leaf
def advance(query, version, spring, servo, dt):
    """Move the tool for one period of dt seconds, in a version of the cells.

    servo : record of SERVO, with `hand` as input, `tool` and `sent` as output. `follower`, `kept`
    and `near` are the coupling's own from period to period; while `tool.version` is 0, it ignores
    their contents and starts anew. The caller preserves `query.missed` between periods. It may
    reset the tool to an earlier pose, but not these three.

    The tool stops before a step into unknown cells. The last wrench is sent for `hold` seconds,
    then falls to zero within `fade` seconds; `sent.unknown` and `missed` then belong to the tried
    pose. Afterwards, and after the first frame, the wrench rises to its full size within `fade`
    seconds and at least RISE_FRAMES frames. With an open clutch the wrench falls to zero, and the
    tool still follows the handle. With a non-finite hand, tool and wrench stay; a non-finite tool
    moves to the first finite hand.

    `sent.wrench` is the wrench at the device, in its units, about the handle's origin: a force of
    min(k |x|, cap) against the stretch x from tool to hand, changed by the damper along it; the
    torque is the moment of this force at the tool's centre, plus that of the rotational spring.
    Without a contact or an obstacle it falls to exactly zero, as fast as `soften_change` allows.
    `tool.felt` has the contacts' wrench on the tool, N and N m of the scene, and their counts.
    `query.contacts` has `sent.hits` points: the `sent.contacts` with a force, and those about to
    have one. `sent.deepest` is onset less distance, m.
    """
    dt = max(dt, 0.0)
    tool, hand, sent, follower = servo.tool, servo.hand, servo.sent, query.follower
    is_hand = is_valid_pose(hand)
    is_held = hand.is_stale or not is_hand
    place_lost(tool, hand, is_hand)
    follower.n_queries = 0
    found = OPEN
    if not is_held:
        found = _move_tool(query, version, spring, tool, hand)
    is_held = is_held or found == NOT_KNOWN
    finish(query, spring, servo, is_held, found, dt)
    sent.unknown = follower.n_unknown if found == NOT_KNOWN else 0
    sent.n_steps = follower.n_queries
