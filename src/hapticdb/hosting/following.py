"""Following: where a hand is between two arrivals of its pose, at the loop's own rate.

At each arrival the hand starts from where it is and moves to the new pose in a little more than the
usual time between two arrivals. So the motion has no jumps, its delay is bounded, and the hand
never goes where nobody has put it: when arrivals stop, it rests at the last pose.
"""

import math

import numpy as np
from numpy.typing import NDArray

from hapticdb.hosting.board import Seats
from hapticdb.kernels.hand.handle import carry
from hapticdb.kernels.motion import play
from hapticdb.kernels.records import OFFSET, pose_numbers

STRETCH = 1.25
"""Time of the way to a new pose, in times between two arrivals. Larger: less stopping when arrivals
come unevenly, and more delay."""
LONGEST_GAP_NS, USUAL_GAP_NS = 60_000_000, 33_000_000
"""Nanoseconds: the longest time between two arrivals that counts, and the one that is assumed
before the second arrival. Larger: smoother for slower senders, and more delay."""
SILENCE_NS = 250_000_000
"""Nanoseconds without an arrival after which the next one says nothing about the sender's rate."""
SHARE_OF_LAST = 0.5
"""Weight of the last time between two arrivals in their mean. Larger: the mean follows a changed
rate sooner, and is more uneven."""


class Following:
    """The way of one hand, from arrival to arrival.

    Parameters
    ----------
    seats : Seats
        Seats of the board.
    row : int
        The session's row.
    hand : record
        () of `kernels.records.HAND`; it starts at the place that is written there.
    """

    def __init__(self, seats: Seats, row: int, hand: NDArray[np.void]) -> None:
        self._arrival = {
            name: seats[name][row : row + 1] for name in ("hand_sequence", "hand_time", "is_held")
        }
        self._new_pose = seats["hand_pose"][row]
        self._hand = hand
        self._position = hand["position"]
        self._numbers = pose_numbers(hand)
        self._seen, self._arrived, self._gap = 0, 0, USUAL_GAP_NS
        self._knots = np.zeros((2, 8))
        self._knots[:, 1:] = self._numbers
        self._knots[1, 0] = 1e-9
        self._from = 0  # ns: the time at which the way began
        self._pose, self._velocity = np.eye(4), np.zeros(6)
        self._offset = np.zeros((), OFFSET)
        self._offset["quaternion"] = 1.0, 0.0, 0.0, 0.0

    def follow(self, now: int) -> None:
        """Write where the hand is at a time, ns; NaN while nobody holds the tool."""
        sequence = int(self._arrival["hand_sequence"][0])
        if sequence != self._seen and sequence % 2 == 0:
            self._take(sequence, now)
        if not self._arrival["is_held"][0]:
            self._position[0] = math.nan
            return
        play((now - self._from) * 1e-9, self._knots, self._pose, self._velocity)
        carry(self._pose, self._velocity, 1.0, self._offset, self._hand)

    def _take(self, sequence: int, now: int) -> None:
        """Begin the way to the pose that has arrived."""
        arrived, pose = int(self._arrival["hand_time"][0]), self._new_pose.copy()
        if int(self._arrival["hand_sequence"][0]) != sequence:
            return  # it is being written again: the next period takes it
        gap, self._arrived, self._seen = arrived - self._arrived, arrived, sequence
        if 0 < gap < SILENCE_NS:
            self._gap += round(SHARE_OF_LAST * (min(gap, LONGEST_GAP_NS) - self._gap))
        is_new = math.isnan(self._position[0])  # the hand takes the tool again, wherever it is now
        self._knots[0, 1:] = pose if is_new else self._numbers
        self._knots[1, 1:] = pose
        self._knots[1, 0] = STRETCH * self._gap * 1e-9
        self._from = now
