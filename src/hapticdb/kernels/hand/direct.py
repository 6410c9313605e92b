"""Direct rendering: contact wrench at the hand's pose, sent to the device without a coupling.

This is the loop of the paper (section 4, Figure 4), under any law. The tool is at the hand and may
penetrate surfaces. The device's caps bound the wrench.
"""

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.hand.device_spring import at_device, shortened
from hapticdb.kernels.hand.fading import is_valid_pose, send, set_result
from hapticdb.kernels.rigid import numbers_of, set_numbers


@leaf
def render(terms, center, servo, frame, dt):
    """Move the tool to the hand, and send the wrench of the frame there to the device.

    terms : a `DeviceSpring`, with stiffness and damping unused; center (3,) : the tool's centre,
    tool frame; servo : record of SERVO, with `hand` as input, `tool` and `sent` as output; frame :
    a RESULT, at the hand's pose. With a stale or non-finite hand, or points in unknown
    cells, the tool stays; its last wrench is sent for `hold` seconds and then falls to zero within
    `fade` seconds.
    """
    tool, hand = servo.tool, servo.hand
    is_lost = hand.is_stale or not is_valid_pose(hand)
    unknown = 0 if is_lost else np.int64(frame.unknown)
    is_held = is_lost or unknown > 0
    if not is_held:
        set_numbers(tool, numbers_of(hand))
        w = frame.wrench
        set_result(
            tool.felt, w, np.int64(frame.hits), np.int64(frame.contacts), unknown, frame.deepest
        )
        force = shortened(w[0], w[1], w[2], terms.cap)
        torque = shortened(w[3], w[4], w[5], terms.turn_cap * terms.scale)
        wrench = at_device(terms, hand, center, *force, *torque)
        for n in range(6):
            tool.kept[n] = wrench[n]
    send(terms, servo, is_held, 0, max(dt, 0.0))
    servo.sent.unknown = unknown
