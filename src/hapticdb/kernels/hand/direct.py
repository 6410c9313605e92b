"""Direct rendering: the wrench of a frame at the hand goes to the device, without a coupling.

This is the loop of the paper (section 4, Figure 4), under either law. The tool is where the hand
is, and nothing keeps it out of surfaces. The device's caps bound the wrench.
"""

import numpy as np

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.hand.device_spring import at_device, shortened
from hapticdb.kernels.hand.holding import is_somewhere, send
from hapticdb.kernels.records import RESULTS
from hapticdb.kernels.resident.cells import UNKNOWNS, WRENCH
from hapticdb.kernels.rigid import numbers_of, set_numbers


@leaf
def render(terms, center, servo, frame, dt):
    """Put the tool where the hand is, and send the wrench of the frame there to the device.

    terms: a `DeviceSpring`, of which stiffness and damping count for nothing. servo, a record of
    SERVO: `tool` is updated, `hand` is read, `sent` is written. frame (RESULTS,): at the hand, of a
    tool with that centre (3,). If the hand is stale or not finite, or points are in unknown cells,
    the tool stays, and its wrench is kept for `hold` seconds and then falls to zero within `fade`
    seconds.
    """
    tool, hand = servo.tool, servo.hand
    is_lost = hand.is_stale or not is_somewhere(hand)
    unknown = 0 if is_lost else np.int64(frame[UNKNOWNS])
    is_held = is_lost or unknown > 0
    if not is_held:
        set_numbers(tool, numbers_of(hand))
        for n in range(RESULTS):
            tool.felt[n] = frame[n]
        force = shortened(frame[WRENCH], frame[WRENCH + 1], frame[WRENCH + 2], terms.cap)
        torque = shortened(
            frame[WRENCH + 3], frame[WRENCH + 4], frame[WRENCH + 5], terms.turn_cap * terms.scale
        )
        wrench = at_device(terms, hand, center, *force, *torque)
        for n in range(6):
            tool.kept[n] = wrench[n]
    send(terms, servo, is_held, 0, max(dt, 0.0))
    servo.sent.unknown = unknown
