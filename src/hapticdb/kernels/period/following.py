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
def _take_arrival(station, seat, hand, now):
    """Start a segment to a new pose in the session's slot (a seqlock), unless half-written."""
    sequence = seat.hand_sequence
    if sequence == station.seen or sequence & 1:
        return
    fence()
    arrived, is_held = seat.hand_time, seat.is_held
    pose, way = seat.hand_pose, station.way
    for n in range(7):
        way.arriving[n] = pose[n]
    fence()
    if seat.hand_sequence != sequence:
        return  # overwritten during the read: the next period retries
    gap = arrived - station.arrived
    station.arrived, station.seen = arrived, sequence
    if 0 < gap < SILENCE_NS:
        station.gap += (min(gap, LONGEST_GAP_NS) - station.gap) // 2
    if not is_held:
        station.is_let_go = 1
        return
    # after a release the hand starts at the pose of its arrival, without a segment
    is_new = station.is_let_go != 0
    for n in range(3):
        way.start[n] = way.arriving[n] if is_new else hand.position[n]
        way.end[n] = way.arriving[n]
    for n in range(4):
        way.start[3 + n] = way.arriving[3 + n] if is_new else hand.quaternion[n]
        way.end[3 + n] = way.arriving[3 + n]
    station.is_let_go = 0
    way.began, way.seconds = now, STRETCH * 1e-9 * station.gap


@leaf
def follow_arrivals(station, seat, hand, now):
    """Write the hand's pose and velocity at a time, ns; position NaN while the hand is released."""
    _take_arrival(station, seat, hand, now)
    position, turned, velocity = hand.position, hand.quaternion, hand.velocity
    if station.is_let_go:
        position[0] = math.nan
        return
    way = station.way
    start, end = way.start, way.end
    passed = 1e-9 * (now - way.began)
    share = 1.0 if passed >= way.seconds else passed / way.seconds
    rate = 0.0 if share == 1.0 else 1.0 / way.seconds
    w, x, y, z = start[3], start[4], start[5], start[6]
    tx, ty, tz = turn_of(*product(end[3], end[4], end[5], end[6], w, -x, -y, -z))
    w, x, y, z = product(*quaternion_by(share * tx, share * ty, share * tz), w, x, y, z)
    length = math.sqrt(w * w + x * x + y * y + z * z)
    turned[0], turned[1], turned[2], turned[3] = w / length, x / length, y / length, z / length
    for axis in range(3):
        position[axis] = (
            end[axis] if share == 1.0 else (start[axis] + share * (end[axis] - start[axis]))
        )
        velocity[axis] = rate * (end[axis] - start[axis])
    velocity[3], velocity[4], velocity[5] = rate * tx, rate * ty, rate * tz
