"""Spring between hand and tool: parameters at the device, wrench in the scene.

One metre of the device is S metres of the scene. Forces are equal in both, so in the scene the
stiffness is K / S and the rotational stiffness S K_R; a torque at the device is the scene's over S.
"""

import math
from typing import NamedTuple

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.rigid import (
    length_at,
    moment,
    moved,
    product,
    transform_of,
    turn_of,
    turned_by,
)

BEYOND_CAP = 1.2
"""Greatest spring force, in caps of the device. Larger: the tool is pressed harder than the hand,
and contacts must be stiffer."""
CONTACT_SHARE = 50.0
"""Least contact stiffness, in stiffnesses of the spring. Larger: contacts yield less."""
STOPPING = 4.0
"""Least contact stiffness, in greatest spring forces a voxel: one point then stops this force
within a quarter of a voxel, in the range of exact distances. Larger: firmer and less smooth."""


class DeviceSpring(NamedTuple):
    """Parameters of the spring between hand and tool; all but `radius` at the device.

    stiffness, turn_stiffness : N/m and N m/rad, above 0. cap, turn_cap : greatest force and torque
    on the hand, N and N m. damping : N s/m, of the hand's motion along the force. scale : S, metres
    of the scene for a metre of the device. radius : m of the scene, from the tool's centre to its
    farthest point. hold, fade : seconds of the unchanged last wrench in unknown cells, and of its
    fall to zero afterwards.
    """

    stiffness: float
    turn_stiffness: float
    cap: float
    turn_cap: float
    damping: float
    scale: float
    radius: float
    hold: float
    fade: float


@leaf
def contact_stiffness(spring, size):
    """Stiffness of a contact, N/m of the scene; size : of a voxel, m."""
    most = BEYOND_CAP * spring.cap
    return max(CONTACT_SHARE * spring.stiffness / spring.scale, STOPPING * most / size)


@leaf
def measure_pull(spring, tool, hand, pose, center, follower):
    """Stretch, m, and rotation vector from tool to hand into follower.pull (6,); stiffnesses too.

    center (3,) : the tool's centre, tool frame; pose (4, 4) : the tool's. The stiffnesses go into
    `follower.pulls`, lowered to bound force and torque by BEYOND_CAP caps.
    """
    at = moved(transform_of(pose), center[0], center[1], center[2])
    pull, at_hand, lever = follower.pull, hand.position, lever_in_hand(hand, center)
    p, q = tool.quaternion, hand.quaternion
    for axis in range(3):
        pull[axis] = at_hand[axis] + lever[axis] - at[axis]
    turned = product(q[0], q[1], q[2], q[3], p[0], -p[1], -p[2], -p[3])  # q p*: from tool to hand
    pull[3], pull[4], pull[5] = turn_of(*turned)
    stiffness = follower.share * spring.stiffness / spring.scale
    turn_stiffness = follower.share * spring.turn_stiffness * spring.scale
    most, most_turn = BEYOND_CAP * spring.cap, BEYOND_CAP * spring.turn_cap * spring.scale
    distance, angle = length_at(pull, 0), length_at(pull, 3)
    # secant stiffness beyond the cap: the gradient of the linear part of psi at this stretch
    follower.pulls[0] = most / distance if stiffness * distance > most else stiffness
    follower.pulls[1] = most_turn / angle if turn_stiffness * angle > most_turn else turn_stiffness


@leaf
def lever_in_hand(hand, center):
    """Lever from the handle's origin to the centre (3,) of a tool at the handle, m, world frame."""
    w, x, y, z = hand.quaternion[0], hand.quaternion[1], hand.quaternion[2], hand.quaternion[3]
    return turned_by(w, x, y, z, center[0], center[1], center[2])


@leaf
def at_device(spring, hand, center, fx, fy, fz, tx, ty, tz):
    """Wrench about the tool's centre (3,) in the hand: at the device, about the handle's origin."""
    rx, ry, rz = lever_in_hand(hand, center)
    # the handle's origin is not the tool's centre: moment of the force about the origin
    mx, my, mz = moment(rx, ry, rz, fx, fy, fz)
    return (
        fx, fy, fz, (tx + mx) / spring.scale, (ty + my) / spring.scale, (tz + mz) / spring.scale,
    )  # fmt: skip


@leaf
def wrench_of(follower, cap, turn_cap):
    """Spring's wrench against follower.pull, about the tool's centre, within caps: N and N m."""
    pull, k, r = follower.pull, follower.pulls[0], follower.pulls[1]
    x, y, z = shortened(-k * pull[0], -k * pull[1], -k * pull[2], cap)
    a, b, c = shortened(-r * pull[3], -r * pull[4], -r * pull[5], turn_cap)
    return x, y, z, a, b, c


@leaf
def shortened(x, y, z, longest):
    """Vector (x, y, z), limited to the length `longest`."""
    length = math.sqrt(x * x + y * y + z * z)
    scale = longest / length if length > longest else 1.0
    return scale * x, scale * y, scale * z
