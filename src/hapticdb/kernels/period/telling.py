"""Outputs of a period to other processes: tool pose, frame, touched objects, counts."""

import math

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.curves import key_of
from hapticdb.kernels.hand.device_spring import contact_stiffness
from hapticdb.kernels.hand.fading import IS_FADING, IS_HELD
from hapticdb.kernels.hand.near_points import FLOOR, depth_of
from hapticdb.kernels.hand.quasistatic import IS_ANEW, IS_INSIDE, IS_SOFTER
from hapticdb.kernels.records.cells import MOST_OBJECT_REQUESTS
from hapticdb.kernels.records.session import MOST_SHOWN, TIME_BIN, TIME_BINS
from hapticdb.kernels.resident.cells import in_voxels
from hapticdb.kernels.resident.fence import fence
from hapticdb.kernels.rigid import length_at, moved, transform_of, turned

HELD, FADING, CLUTCH_OPEN, IN_OBJECT, STALE, ANEW = 1, 2, 4, 8, 16, 32
"""Bits of a frame's state, named in `hapticdb.recording.frame.State`."""


@leaf
def tell(request, hand, pose, center, radius, missed):
    """Write a prefetch request: tool, hand and the unknown cells of the last query.

    request : a REQUEST, a seqlock: its sequence number is odd during a write; pose (4, 4), center
    (3,): of the tool; radius : of its farthest point; missed : a MISSED.
    """
    told, transform = request.prefetch, transform_of(pose)
    x, y, z = moved(transform, center[0], center[1], center[2])
    request.sequence += 1  # odd: readers skip it
    fence()
    told.is_active = True
    told.tool[0], told.tool[1], told.tool[2] = x, y, z
    told.radius = radius
    lever = turned(transform, center[0], center[1], center[2])
    for axis in range(3):
        told.handle[axis] = hand.position[axis] + lever[axis]
        told.velocity[axis] = hand.velocity[axis]
    request.missed.n_cells = missed.n_cells
    for n in range(missed.n_cells):
        request.missed.cells[n] = missed.cells[n]
    fence()
    request.sequence += 1  # even: complete


@leaf
def name_voxels(request, shell, pose, place, bits, curve, met, n_hits):
    """Request the ids of the objects in the voxels hit by a placed shell: write the voxels' keys.

    `met` (n_hits,): indices of the hits, decimated to at most MOST_OBJECT_REQUESTS.
    """
    # ceiling: the stride spreads the requests over all hits
    step = max((n_hits + MOST_OBJECT_REQUESTS - 1) // MOST_OBJECT_REQUESTS, 1)
    count = 0
    transform = transform_of(pose)
    for hit in range(0, n_hits, step):
        n = met[hit]
        x, y, z = in_voxels(
            transform, place, shell.points[n, 0], shell.points[n, 1], shell.points[n, 2]
        )
        request.asked[count] = key_of(np.int64(x), np.int64(y), np.int64(z), bits, curve)
        count += 1
    request.n_asked = count


@leaf
def list_touching(query, n_hits):
    """Number of touching points, listed in `query.contacts`.

    For a loose tool (inside an object, without contacts) these are the points inside. Their voxels
    may be free: the fetching process also searches around them.
    """
    if not query.follower.is_loose:
        return n_hits
    near, n_found = query.near[query.follower.side], np.int64(0)
    for m in range(query.follower.n_near):
        if near[m].u < FLOOR:
            query.contacts[n_found] = near[m].point
            n_found += 1
    return n_found


@leaf
def note(ring, slot, time, dt, lateness, elapsed):
    """Record the present frame in its row of the ring buffer (capacity,) of FRAME."""
    servo, spring = slot.servo, slot.springs[slot.used_spring]
    tool, hand, sent = servo.tool, servo.hand, servo.sent
    # the ring's row is overwritten after one turn, whether it was read or not
    row = ring[slot.n_frames % ring.shape[0]]
    row.time = time
    row.dt = dt
    row.lateness = lateness
    row.elapsed = elapsed
    for n in range(3):
        row.hand[n] = hand.position[n]
        row.tool[n] = tool.position[n]
    for n in range(4):
        row.hand[3 + n] = hand.quaternion[n]
        row.tool[3 + n] = tool.quaternion[n]
    for n in range(6):
        row.hand_velocity[n] = hand.velocity[n]
        row.applied[n] = sent.wrench[n]
    for n in range(spring.shape[0]):
        row.spring[n] = spring[n]
    row.hits, row.contacts, row.deepest = sent.hits, sent.contacts, sent.deepest
    row.unknown = sent.unknown  # at the tried pose
    row.revision = sent.revision
    row.buttons = slot.reading.buttons
    state = CLUTCH_OPEN if hand.is_open else 0
    state |= HELD if sent.marks & IS_HELD else 0
    state |= FADING if sent.marks & IS_FADING else 0
    state |= STALE if hand.is_stale else 0
    state |= ANEW if sent.marks & IS_ANEW else 0
    row.state = state | (IN_OBJECT if sent.marks & IS_INSIDE else 0)


@leaf
def count(slot):
    """Add a frame to the session's counts."""
    sent, hand, follower = slot.servo.sent, slot.servo.hand, slot.follower
    marks, wrench = sent.marks, sent.wrench
    slot.peak_force = max(slot.peak_force, length_at(wrench, 0))
    slot.peak_torque = max(slot.peak_torque, length_at(wrench, 3))
    slot.hit_frames += sent.hits > 0
    if sent.contacts > 0:
        slot.contact_frames += 1
        slot.deepest = max(slot.deepest, sent.deepest)
    slot.unknown_frames += sent.unknown > 0
    slot.held_frames += (marks & IS_HELD) != 0
    slot.stale_frames += hand.is_stale
    slot.invalid_frames += math.isnan(hand.position[0])
    slot.ended_inside = (marks & IS_INSIDE) != 0
    if slot.ended_inside and slot.inside_frames == 0:
        slot.first_inside_frame = slot.n_frames
    slot.inside_frames += slot.ended_inside
    slot.guard_actions += (marks & IS_SOFTER) != 0
    slot.least_share = follower.wanted_share if follower.wanted_share > 0.0 else 1.0


@leaf
def _bin_of(seconds):
    """Histogram bin of a time, clamped: with a test's clock a time may be negative."""
    return min(max(np.int64(seconds / TIME_BIN), np.int64(0)), np.int64(TIME_BINS))


@leaf
def count_times(slot, lateness, elapsed):
    """Count a frame's lateness and computing time, seconds."""
    slot.lateness[_bin_of(lateness)] += 1
    slot.elapsed[_bin_of(elapsed)] += 1
    slot.worst_lateness = max(slot.worst_lateness, lateness)
    slot.worst_elapsed = max(slot.worst_elapsed, elapsed)


@leaf
def show_contacts(slot, query, pose, spring):
    """Publish points, m, and forces, N, of at most MOST_SHOWN contacts in the slot, world frame."""
    follower, points, transform = query.follower, query.shell.points, transform_of(pose)
    near, n_near = query.near[follower.side], 0 if follower.is_loose else follower.n_near
    stiffness = contact_stiffness(spring, query.grid.size)
    n_contacts = 0
    for m in range(n_near):
        # counted first: the stride spreads the published contacts over all of them
        n_contacts += depth_of(query, near[m]) > 0.0
    every = max((n_contacts + MOST_SHOWN - 1) // MOST_SHOWN, 1)
    slot.contacts_sequence += 1  # seqlock, as in `tell`
    fence()
    n_published = n_shown = 0
    for m in range(n_near):
        n, depth = near[m].point, depth_of(query, near[m])
        if depth <= 0.0:
            continue
        n_published += 1
        if (n_published - 1) % every == 0:
            row, force = slot.contacts[n_shown], stiffness * depth
            row[0], row[1], row[2] = moved(transform, points[n, 0], points[n, 1], points[n, 2])
            for axis in range(3):
                row[3 + axis] = force * near[m].along[axis]
            n_shown += 1
    slot.n_contacts = n_shown
    fence()
    slot.contacts_sequence += 1


@leaf
def show_objects(slot, request):
    """Copy the ids of touched objects from the request queue to the slot."""
    # written by another process: not trusted as a bound of the array
    n_objects = min(request.n_objects, np.int64(MOST_OBJECT_REQUESTS))
    for n in range(n_objects):
        slot.objects[n] = request.objects[n]
    slot.n_objects = n_objects
