"""The path of a scripted hand, known before the session begins."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.scripted import Device, Player, RandomHand, Tumble
from hapticdb.devices.simulated import SimulatedDevice
from hapticdb.poses import rotation_of
from hapticdb.realtime.handle import Handle

SWAY = 1.0
"""Greatest distance (m) of a `RandomHand` or `Tumble` from its centre. Larger: fewer misfits of the
path are reported."""


def path_of_hand(device: Device, handle: Handle) -> tuple[NDArray[np.float64] | None, float]:
    """Poses (M, 4, 4) that the tool will take, and how far it may leave them; metres of the scene.

    None and 0 if the path is not known in advance: a real device, or a handle with its own start.
    """
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
