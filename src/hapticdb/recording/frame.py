"""One frame of the loop, as it is recorded."""

import enum

import numpy as np
from numpy.typing import NDArray

Frames = NDArray[np.void]


class State(enum.IntFlag):
    """Bits of a frame's `state`."""

    HELD = 1
    """The wrench was kept from an earlier frame."""
    FADING = 2
    """It was kept for so long that it fell towards zero."""
    CLUTCH_OPEN = 4
    """The handle did not follow the hand."""


FRAME: np.dtype[np.void] = np.dtype(
    [
        ("time", "<f8"),  # s since the session's start, when the frame began
        ("dt", "<f8"),  # s since the frame before
        ("lateness", "<f4"),  # s behind its deadline
        ("elapsed", "<f4"),  # s that computing took
        ("hand", "<f8", (7,)),  # the handle: position m, unit quaternion, scalar first
        ("hand_velocity", "<f8", (6,)),  # m/s, rad/s
        ("tool", "<f8", (7,)),  # the simulated body, likewise
        ("wrench", "<f8", (6,)),  # contact wrench at `tool`, about its centre: N, N m
        ("applied", "<f8", (6,)),  # sent to the device, about the handle's origin: N, N m
        ("hits", "<i4"),
        ("contacts", "<i4"),
        ("unknown", "<i4"),  # points in cells that were not resident
        ("deepest", "<f4"),  # m
        ("revision", "<i8"),  # of the database
        ("buttons", "<i4"),  # bit mask
        ("state", "<i4"),  # bits of `State`
    ]
)
"""One frame of the loop."""
