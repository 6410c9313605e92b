"""Stability of the force: damping along it, oscillation guard, and limited rate of change."""

import math

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.records.hand import MOST_TRAIL

WINDOW = 4e-3
"""Seconds of the hand's speed measurement. Larger: later damping; over one sample, a device's
position steps make the damper chatter."""
TRAIL_STEP = WINDOW / (MOST_TRAIL - 8)
"""Least seconds between two stored positions of the hand, from `WINDOW`."""
REVERSAL = 0.3
"""Least return of the force from an extreme, N, for a reversal. Larger: smaller oscillations
pass."""
FORGOTTEN = 0.1
"""Time constant of the reversals' decay, s. Larger: slower oscillations are detected, and quick
taps count, too."""
MOST_REVERSALS = 3.0
"""Most decayed reversals without action of the guard. Larger: longer oscillations."""
SOFTER = 0.8
"""Factor on the stiffness at each action of the guard."""
LEAST_SHARE = 0.2
"""Least share of the stiffness under the guard."""
SHARE_RATE = 10.0
"""Fall of this share, 1/s. Larger: the guard acts sooner, and the force changes faster."""
MOST_CHANGE = 1000.0
"""Greatest rate of a force, N/s, on top of the change by the hand's motion, when the tool snaps off
an edge or from one face to another. Larger: sharper edges, harder snaps."""


@leaf
def begin_steady(follower):
    """Reset the trail of the hand and the guard, with the full stiffness."""
    follower.n_trail = 0
    follower.clock = follower.reversals = follower.extreme = 0.0
    follower.share = follower.wanted_share = 1.0
    follower.is_rising = True


@leaf
def remember_hand(follower, hand, dt):
    """Append the handle's position to the trail, at most once in TRAIL_STEP."""
    trail, position = follower.trail, hand.position
    follower.clock += dt
    newest = (follower.n_trail - 1) % MOST_TRAIL
    if follower.n_trail > 0 and follower.clock - trail[newest, 0] < TRAIL_STEP:
        return
    at = follower.n_trail % MOST_TRAIL
    trail[at, 0] = follower.clock
    for axis in range(3):
        trail[at, 1 + axis] = position[axis]
    follower.n_trail += 1


@leaf
def hand_speed(follower, hand, x, y, z):
    """Speed of the handle along the unit vector (x, y, z), m/s of the scene, over `WINDOW`."""
    trail, position = follower.trail, hand.position
    oldest = max(follower.n_trail - MOST_TRAIL, 0)
    n = follower.n_trail - 1
    # newest stored position at least WINDOW old; the margin is for rounding of the summed clock
    while n > oldest and follower.clock - trail[n % MOST_TRAIL, 0] < WINDOW * (1.0 - 1e-6):
        n -= 1
    if n < 0:
        return 0.0
    at = n % MOST_TRAIL
    passed = follower.clock - trail[at, 0]
    if passed <= 0.0:
        return 0.0
    distance = (position[0] - trail[at, 1]) * x
    distance += (position[1] - trail[at, 2]) * y
    distance += (position[2] - trail[at, 3]) * z
    return distance / passed


@leaf
def guard_stiffness(follower, force, dt):
    """Count the force's reversals and lower the stiffness after many; return whether it did.

    force : N, of the spring alone.
    """
    follower.reversals *= math.exp(-dt / FORGOTTEN)
    ahead = force - follower.extreme
    # peak detection with hysteresis: the extreme moves along until the force returns by REVERSAL
    if (ahead >= 0.0) == follower.is_rising:
        follower.extreme = force
    elif abs(ahead) > REVERSAL:
        follower.extreme, follower.is_rising = force, not follower.is_rising
        follower.reversals += 1.0
    has_acted = follower.reversals > MOST_REVERSALS and follower.wanted_share > LEAST_SHARE
    if has_acted:
        follower.reversals = 0.0  # count anew under the lower stiffness
        follower.wanted_share = max(SOFTER * follower.wanted_share, LEAST_SHARE)
    follower.share = max(follower.share - SHARE_RATE * dt, follower.wanted_share)
    return has_acted


@leaf
def soften_change(kept, wrench, allowed):
    """Limit the change of force from kept (6,) to wrench (6,), in place -> whether it was limited.

    allowed : greatest change, N. The torque changes by the same share.
    """
    x, y, z = wrench[0] - kept[0], wrench[1] - kept[1], wrench[2] - kept[2]
    change = math.sqrt(x * x + y * y + z * z)
    if change <= allowed:
        return False
    share = allowed / change
    # one share for all: the wrench stays on the segment between both wrenches
    for axis in range(6):
        wrench[axis] = kept[axis] + share * (wrench[axis] - kept[axis])
    return True
