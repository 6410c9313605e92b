"""Where a hand will go, as far as its class says so before it moves."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.scripted import Device, Player, RandomHand, Tumble
from hapticdb.devices.simulated import SimulatedDevice
from hapticdb.poses import rotation_of
from hapticdb.realtime.handle import Handle

SWAY = 1.0
"""Metres that a hand which moves about a place may leave it by, more than any does."""


def way_of(device: Device, handle: Handle) -> tuple[NDArray[np.float64] | None, float]:
    """Poses (M, 4, 4) of the handle, scene metres, and how far it leaves them; None: not known."""
    hand = device.hand if isinstance(device, SimulatedDevice) else device
    if isinstance(hand, Player):
        poses = np.tile(np.eye(4), (len(hand._knots), 1, 1))  # noqa: SLF001 - same room
        poses[:, :3, 3] = hand._knots[:, 1:4]  # noqa: SLF001
        poses[:, :3, :3] = rotation_of(hand._knots[:, 4:8])  # noqa: SLF001
        sway = 0.0
    elif isinstance(hand, (RandomHand, Tumble)):
        poses, sway = np.array(hand._pose)[None].copy(), SWAY * handle.scale  # noqa: SLF001
        if isinstance(hand, RandomHand):
            poses[0] = hand._center  # noqa: SLF001
    else:
        return None, 0.0
    if handle.starts_elsewhere:
        return None, 0.0
    poses[:, :3, 3] *= handle.scale
    return poses, sway
