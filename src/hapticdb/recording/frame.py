"""One recorded frame of the loop."""

import enum

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.records.hand import FRAME

__all__ = ["FRAME", "Frames", "State"]

Frames = NDArray[np.void]


class State(enum.IntFlag):
    """Bits of a frame's `state`."""

    HELD = 1
    """The wrench of an earlier frame was repeated."""
    FADING = 2
    """The wrench was repeated for so long that it fell towards zero."""
    CLUTCH_OPEN = 4
    """The handle did not follow the hand."""
    IN_OBJECT = 8
    """The tool was in an object, from the start or since a part was moved onto it, without a
    wrench; only with a coupling."""
    STALE = 16
    """The database had not responded for too long, so tool and wrench were frozen."""
    ANEW = 32
    """The cells had changed, so the coupling evaluated the distances of all points."""
