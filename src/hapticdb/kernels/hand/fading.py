"""Periods without a new force: hold, fade and rise of the last wrench, and their marks."""

import math

import numpy as np

from hapticdb.kernels._jit import inlined, leaf
from hapticdb.kernels.force_law import NO_WRENCH
from hapticdb.kernels.rigid import numbers_of, set_numbers

IS_HELD, IS_FADING, IS_DROPPED, IS_CUT = 1, 2, 8, 16
"""Marks of a period: last wrench sent again; that wrench falling or zero; part of the period not
simulated; tool stopped by a surface."""
RISE_FRAMES = 4
"""Fewest frames of a wrench's rise to full size: no jump after a long period. Larger: slower."""


@inlined
def is_finite(numbers):
    """Whether all numbers (n,) are finite."""
    count = 0
    for n in range(numbers.shape[0]):
        count += math.isfinite(numbers[n])
    return count == numbers.shape[0]


@leaf
def is_valid_pose(hand):
    """Whether position, quaternion and velocity of a hand are finite."""
    return is_finite(hand.position) and is_finite(hand.quaternion) and is_finite(hand.velocity)


@leaf
def set_result(result, wrench, hits, contacts, unknown, deepest):
    """Write a RESULT; wrench : six numbers."""
    for n in range(6):
        result.wrench[n] = wrench[n]
    result.hits, result.contacts = hits, contacts
    result.unknown, result.deepest = unknown, deepest


@leaf
def begin_anew(tool):
    """Reset a tool's state to zero, except its position and quaternion."""
    for n in range(6):
        tool.kept[n] = 0.0
    set_result(tool.felt, NO_WRENCH, 0, 0, 0, 0.0)
    for row in range(4):
        for column in range(4):
            tool.pose[row, column] = tool.tried_pose[row, column] = 0.0
    tool.held_for = tool.risen = 0.0
    tool.version = 0


@leaf
def place_lost(tool, hand, is_hand):
    """Reset a tool with a non-finite state; it moves to the hand if `is_hand`."""
    is_placed = is_finite(tool.position) and is_finite(tool.quaternion)
    # all that feeds back from period to period: one NaN would stay for ever
    if is_placed and is_finite(tool.kept) and math.isfinite(tool.held_for):
        return
    begin_anew(tool)
    if is_hand:
        set_numbers(tool, numbers_of(hand))


@leaf
def send(terms, servo, is_held, marks, dt):
    """Write `servo.sent`: the share of the tool's wrench not faded, its counts, and the marks."""
    tool, hand, sent = servo.tool, servo.hand, servo.sent
    share, is_fading = _share_of_wrench(terms, tool, hand, is_held, dt)
    for n in range(6):
        sent.wrench[n] = share * tool.kept[n]
    sent.marks = marks | (IS_HELD if is_held else 0) | (IS_FADING if is_fading else 0)
    sent.hits, sent.contacts = np.int64(tool.felt.hits), np.int64(tool.felt.contacts)
    sent.deepest = tool.felt.deepest


@leaf
def _share_of_wrench(terms, tool, hand, is_held, dt):
    """Share of the wrench to send, and whether it is fading.

    terms : with `hold` and `fade`, s. The share falls while `is_held` and rises again afterwards;
    with an open clutch it falls to zero.
    """
    passed = dt / terms.fade
    faded = 0.0
    if is_held:
        tool.held_for += dt
        faded = _faded_share(terms, tool.held_for)
    else:
        # the rise begins at the faded level, so the first new wrench does not jump
        tool.risen *= 1.0 - _faded_share(terms, tool.held_for)
        tool.held_for = 0.0
        if not hand.is_open:
            # bounded per frame as well: dt of a long period would allow the whole rise at once
            tool.risen = min(tool.risen + min(passed, 1.0 / RISE_FRAMES), 1.0)
    if hand.is_open:
        # open clutch: the fall works beside that of lost cells
        tool.risen = max(tool.risen - passed, 0.0)
    return (1.0 - faded) * tool.risen, faded > 0.0


@leaf
def _faded_share(terms, seconds):
    """Share lost, 0 to 1, by a wrench after so many seconds without a new one."""
    return min(max((seconds - terms.hold) / terms.fade, 0.0), 1.0)
