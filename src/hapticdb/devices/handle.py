"""Handle: pose and velocity of the hand in the scene, after scale and clutch."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.devices.protocol import Reading
from hapticdb.devices.scripted import pose_at
from hapticdb.errors import UsageError
from hapticdb.kernels.hand.handle_motion import follow
from hapticdb.kernels.records.hand import HANDLE
from hapticdb.kernels.records.layout import pose_numbers
from hapticdb.kernels.rigid import is_rigid
from hapticdb.poses import quaternion_of

Floats = NDArray[np.float64]
Hand = NDArray[np.void]
"""A record () of `kernels.records.hand.HAND`."""
MOST_SCALE = 1e6
"""Greatest scale: a millimetre of the hand is a kilometre of the scene."""
NO_POSE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""Position and unit quaternion of the identity."""


class Handle:
    """The handle: the hand's pose in the scene, to which the tool is coupled.

    While the clutch is open the hand moves and the handle stays; once it is closed the handle moves
    on from its pose. After a reading that is not finite, or beyond 1e9 m, m/s or rad/s, the handle
    has no pose (its x is NaN) until the next valid reading. A handle has the state of one session.

    scale : S, metres of the scene for one metre of the device. Turns and forces are not scaled; a
    torque at the device is the scene's over S, and stiffness is the device's at every scale.
    start : pose (4, 4) or point (3,) of the handle at the start, scene metres; the hand's pose, its
    position scaled, unless given. clutch : button that opens the clutch while pressed.

    Raises `UsageError` if a number is out of its range or the start is no rigid transform.
    """

    def __init__(
        self, *, scale: float = 1.0, start: ArrayLike | None = None, clutch: int | None = None
    ) -> None:
        if not 0.0 < scale <= MOST_SCALE:
            raise UsageError(f"a scale of {scale}: give a number above 0, {MOST_SCALE:g} at most")
        if clutch is not None and not 0 <= clutch < 31:
            raise UsageError(f"button {clutch} for the clutch: give 0 to 30")
        self.scale = float(scale)
        self.record = np.zeros((), HANDLE)
        """Record of `HANDLE`, for the kernels."""
        self.record["scale"], self.record["clutch"] = scale, 0 if clutch is None else 1 << clutch
        if start is not None:
            pose = pose_at(start)
            if not is_rigid(pose):
                raise UsageError("a handle starts at a pose that is a rigid transform")
            self.record["starts_elsewhere"] = True
            self.record["start"] = (*pose[:3, 3], *quaternion_of(pose[:3, :3])[0])

    def start(self, reading: Reading, hand: Hand) -> None:
        """Place the handle for a reading, at rest; writes `hand`, except its `is_stale`.

        Without a valid pose in the reading, `follow` places the handle at the next valid one.
        """
        self.record["is_placed"] = hand["is_open"] = False
        pose_numbers(hand)[:] = (math.nan, *NO_POSE[1:])
        self.follow(reading, hand)
        hand["velocity"] = 0.0

    def follow(self, reading: Reading, hand: Hand) -> None:
        """Move the handle by the hand's motion up to a reading; writes `hand`."""
        follow(self.record, reading.pose, reading.velocity, reading.buttons, hand)
