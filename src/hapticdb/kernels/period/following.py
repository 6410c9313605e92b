"""Interpolation of a hosted hand between arrivals of its pose, at the loop's own rate.

At each arrival the hand starts a segment from its present pose to the new one, a little longer than
the mean time between arrivals. So the motion is continuous, its delay is bounded, and nothing is
extrapolated: when arrivals stop, the hand rests at the last pose.
"""

import math

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.resident.fence import fence
from hapticdb.kernels.rigid import product, quaternion_by, turn_of

STRETCH = 1.25
"""Duration of a segment, in mean times between arrivals. Larger: fewer stops when arrivals are
uneven, and more delay."""
LONGEST_GAP_NS, USUAL_GAP_NS = 60_000_000, 33_000_000
"""Nanoseconds: cap on the time between two arrivals, and its value before the second one. Larger:
smoother for slower senders, and more delay."""
SILENCE_NS = 250_000_000
"""Nanoseconds between two arrivals from which on they do not count in the rate."""


@leaf
def _take_arrival(slot, hand, now):
    """Start a segment to a new pose in the slot (a seqlock), unless half-written."""
    sequence = slot.hand_sequence
    if sequence == slot.seen or sequence & 1:  # odd: a write is in progress
        return
    # both fences: the copy stays between the two reads of the sequence number
    fence()
    arrived, pose, segment = slot.hand_time, slot.hand_pose, slot.segment
    for n in range(7):
        # into scratch: a torn pose must not reach `end`
        segment.arriving[n] = pose[n]
    fence()
    if slot.hand_sequence != sequence:
        return  # overwritten during the read: the next period retries
    gap = arrived - slot.arrived
    slot.arrived, slot.seen = arrived, sequence
    if 0 < gap < SILENCE_NS:
        slot.gap += (min(gap, LONGEST_GAP_NS) - slot.gap) // 2  # exponential mean
    # from the present pose, not from the old end: the motion stays continuous
    for n in range(3):
        segment.start[n] = hand.position[n]
    for n in range(4):
        segment.start[3 + n] = hand.quaternion[n]
    for n in range(7):
        segment.end[n] = segment.arriving[n]
    segment.began, segment.seconds = now, STRETCH * 1e-9 * slot.gap


@leaf
def follow_arrivals(slot, hand, now):
    """Write the hand's pose and velocity at a time, ns."""
    _take_arrival(slot, hand, now)
    position, turned, velocity = hand.position, hand.quaternion, hand.velocity
    segment = slot.segment
    start, end = segment.start, segment.end
    passed = 1e-9 * (now - segment.began)
    share = 1.0 if passed >= segment.seconds else passed / segment.seconds
    rate = 0.0 if share == 1.0 else 1.0 / segment.seconds
    w, x, y, z = start[3], start[4], start[5], start[6]
    # slerp by the rotation vector from start to end
    tx, ty, tz = turn_of(*product(end[3], end[4], end[5], end[6], w, -x, -y, -z))
    w, x, y, z = product(*quaternion_by(share * tx, share * ty, share * tz), w, x, y, z)
    length = math.sqrt(w * w + x * x + y * y + z * z)
    turned[0], turned[1], turned[2], turned[3] = w / length, x / length, y / length, z / length
    for axis in range(3):
        position[axis] = (
            # no interpolation at the end: start + (end - start) may round
            end[axis] if share == 1.0 else (start[axis] + share * (end[axis] - start[axis]))
        )
        velocity[axis] = rate * (end[axis] - start[axis])
    velocity[3], velocity[4], velocity[5] = rate * tx, rate * ty, rate * tz
