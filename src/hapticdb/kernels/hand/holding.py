"""What a period does without a new force: marks, and how the last wrench fades and rises again."""

import math

import numpy as np

from hapticdb.kernels._jit import inlined, leaf
from hapticdb.kernels.records import RESULTS
from hapticdb.kernels.resident.cells import CONTACTS, DEEPEST, HITS
from hapticdb.kernels.rigid import numbers_of, set_numbers

IS_HELD, IS_FADING, IS_DROPPED, IS_CUT = 1, 2, 8, 16
"""Marks of a period: the last wrench was kept; the kept wrench falls or is zero; part of the period
was not simulated; a surface held the tool back."""
RISE_FRAMES = 4
"""Fewest frames in which a wrench rises to its full size, so that it does not jump after a long
period. Larger: a slower rise."""


@inlined
def is_finite(numbers):
    """Whether all numbers (n,) are finite."""
    count = 0
    for n in range(numbers.shape[0]):
        count += math.isfinite(numbers[n])
    return count == numbers.shape[0]


@leaf
def is_somewhere(hand):
    """Whether position, turn and velocity of a hand are finite."""
    return is_finite(hand.position) and is_finite(hand.quaternion) and is_finite(hand.velocity)


@leaf
def begin_anew(tool):
    """Set a tool's state to zero, except its position and quaternion."""
    for n in range(6):
        tool.kept[n] = 0.0
    for n in range(RESULTS):
        tool.felt[n] = 0.0
    for row in range(4):
        for column in range(4):
            tool.pose[row, column] = tool.tried_pose[row, column] = 0.0
    tool.held_for = tool.risen = 0.0
    tool.version = 0


@leaf
def place_lost(tool, hand, is_hand):
    """Begin anew, at the hand if there is one, with a tool that is not finite."""
    is_placed = is_finite(tool.position) and is_finite(tool.quaternion)
    if is_placed and is_finite(tool.kept) and math.isfinite(tool.held_for):
        return
    begin_anew(tool)
    if is_hand:
        set_numbers(tool, numbers_of(hand))


@leaf
def send(terms, servo, is_held, marks, dt):
    """Send the tool's kept wrench, as far as it has not faded, its counts, and the marks."""
    tool, hand, sent = servo.tool, servo.hand, servo.sent
    share, is_fading = _share_of_wrench(terms, tool, hand, is_held, dt)
    for n in range(6):
        sent.wrench[n] = share * tool.kept[n]
    sent.marks = marks | (IS_HELD if is_held else 0) | (IS_FADING if is_fading else 0)
    sent.hits, sent.contacts = np.int64(tool.felt[HITS]), np.int64(tool.felt[CONTACTS])
    sent.deepest = tool.felt[DEEPEST]


@leaf
def _share_of_wrench(terms, tool, hand, is_held, dt):
    """Share of the wrench that is sent: it fades while cells are unknown, and rises again.

    terms: hold and fade, s. While the clutch is open the share falls to zero.
    """
    passed = dt / terms.fade
    faded = 0.0
    if is_held:
        tool.held_for += dt
        faded = _faded_share(terms, tool.held_for)
    else:
        tool.risen *= 1.0 - _faded_share(terms, tool.held_for)
        tool.held_for = 0.0
        if not hand.is_open:
            tool.risen = min(tool.risen + min(passed, 1.0 / RISE_FRAMES), 1.0)
    if hand.is_open:
        tool.risen = max(tool.risen - passed, 0.0)
    return (1.0 - faded) * tool.risen, faded > 0.0


@leaf
def _faded_share(terms, seconds):
    """Share, 0 to 1, by which a wrench has faded that was kept for so many seconds."""
    return min(max((seconds - terms.hold) / terms.fade, 0.0), 1.0)
