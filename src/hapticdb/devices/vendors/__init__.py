"""Vendors' devices, each driven through a package or service.

Imports and hardware access wait for `open`, so a device can be pickled into its process.
"""

import importlib
import math
from collections import deque
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import DeviceError, MissingExtraError, pip_line

WINDOW = 0.02
"""Window, s, of the velocity of a device that reports none. Larger: smoother, later."""


def load(module: str, extra: str) -> ModuleType:
    """Import the driver module of a device.

    Raises `MissingExtraError` without its package, `DeviceError` without the vendor's own library.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"this device needs the package {error.name}: {pip_line(extra)}"
        ) from error
    except (ImportError, OSError) as error:
        reason = str(error).partition("\n")[0]
        raise DeviceError(f"{module}: {reason}; install the SDK of the device's maker") from error


class VelocityWindow:
    """Velocity of a hand: finite difference of its poses over a window of 20 ms."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, NDArray[np.float64]]] = deque()

    def measure(self, now: float, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Velocity (6,), m/s and rad/s, from the earlier poses (4, 4) and this one at `now`, s."""
        seen = self._seen
        while len(seen) > 1 and seen[1][0] <= now - WINDOW:
            seen.popleft()
        velocity = np.zeros(6)
        if seen and now > seen[0][0]:
            before, last = seen[0]
            turn = pose[:3, :3] @ last[:3, :3].T
            x, y, z = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
            sine, cosine = math.sqrt(x * x + y * y + z * z), float(np.trace(turn)) - 1.0
            # sine and cosine are doubled; for small turns the quotient tends to one half
            scale = math.atan2(sine, cosine) / sine if sine > 1e-12 else 0.5
            velocity[:3] = pose[:3, 3] - last[:3, 3]
            velocity[3:] = scale * x, scale * y, scale * z
            velocity /= now - before
        seen.append((now, pose))
        return velocity
