"""Devices of 3D Systems (Touch, Touch X, Phantom) through OpenHaptics.

Written from the README and the sources of `pyopenhaptics` 1.0.1, which calls OpenHaptics 3.4. The
device's state is readable only in a callback of the OpenHaptics scheduler, at 1000 Hz in a thread
of its own. So the callback stores the reading for `read`, and sends the force stored by `apply`.
The package gives neither velocity nor torque: velocities are measured over 20 ms, torque is
ignored. The library itself comes from the vendor.
"""

import contextlib
import io
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.profiles import PROFILES, DeviceProfile
from hapticdb.devices.protocol import Reading
from hapticdb.devices.scripted import Clock, capped
from hapticdb.devices.vendors import VelocityWindow, load
from hapticdb.errors import DeviceError

INVALID_HANDLE = 0xFFFFFFFF
"""HD_INVALID_HANDLE, returned by hdInitDevice if there is no device."""

SILENCE = 0.1
"""Longest time between callbacks, s; then the device counts as lost."""

STALE = 0.05
"""Age, s, at which a force without successor becomes zero: the scheduler would repeat the last
force for ever if the loop stopped."""


class OpenHapticsDevice:
    """A device of 3D Systems; its frame is that of OpenHaptics: x right, y up, z towards the user.

    name : of the device in the vendor's setup; profile : the model's, as of
    `hapticdb.devices.profiles.PROFILES`, a Touch unless given; clock : seconds, picklable.
    """

    def __init__(
        self, name: str = "Default Device", *, profile: DeviceProfile = PROFILES["touch"],
        clock: Clock = time.perf_counter,
    ) -> None:  # fmt: skip
        self.name = name
        self.profile = profile
        self.clock = clock
        self._hd: Any = None
        self._id = 0
        self._callback: Any = None
        # each tuple is replaced as a whole, so no thread reads a half-written one
        self._seen: tuple[float, Reading] | None = None
        self._push: tuple[float, list[float]] = (0.0, [0.0, 0.0, 0.0])

    def open(self) -> None:
        """Open the device and wait for the first callback of its scheduler."""
        hd = load("pyOpenHaptics.hd", "openhaptics")
        callbacks = load("pyOpenHaptics.hd_callback", "openhaptics")
        # the package prints its progress and its errors to standard output
        with contextlib.redirect_stdout(io.StringIO()) as output:
            device = hd.init_device(self.name)
            if device is None or device == INVALID_HANDLE:
                raise DeviceError(f"no OpenHaptics device named {self.name!r}; is it plugged in?")
            hd.enable_force()
            hd.start_scheduler()
            if _has_failed(hd):
                hd.stop_scheduler()
                hd.close_device(device)
                raise DeviceError(
                    f"OpenHaptics failed to start: {output.getvalue().strip()[-200:]}"
                )
        self._hd, self._id, self._seen = hd, device, None
        window = VelocityWindow()
        # the reference keeps the callback alive: OpenHaptics calls it while the scheduler runs
        self._callback = callbacks.hd_callback(lambda: self._serve(hd, window))
        callbacks.hdAsyncSheduler(self._callback)
        deadline = self.clock() + 1.0
        while self._seen is None and self.clock() < deadline:
            time.sleep(0.001)
        if self._seen is None:
            self.close()
            raise DeviceError("the OpenHaptics scheduler does not call; restart its driver")

    def _serve(self, hd: Any, window: VelocityWindow) -> None:  # noqa: ANN401 - a module without types
        """Store the reading and send the force; runs in each frame of the scheduler."""
        now = self.clock()
        # an OpenGL matrix: column by column, in millimetres
        pose = np.array(hd.get_transform(), dtype=np.float64).T.copy()
        pose[:3, 3] *= 1e-3
        buttons = int(hd.get_buttons())
        self._seen = now, Reading(pose, window.measure(now, pose), buttons)
        since, force = self._push
        hd.set_force(force if now - since <= STALE else [0.0, 0.0, 0.0])

    def read(self) -> Reading:
        """Return pose, velocity and buttons of the scheduler's last callback."""
        if self._seen is None:
            raise DeviceError("the OpenHaptics device is not open; call open() first")
        when, reading = self._seen
        if self.clock() - when > SILENCE:
            raise DeviceError("the OpenHaptics device went silent; check its cable and power")
        return reading

    def apply(self, wrench: NDArray[np.float64]) -> None:
        """Push with the force of a wrench (6,), N, capped; the torque is ignored."""
        self._push = self.clock(), capped(wrench, self.profile.cap, 0.0).tolist()[:3]

    def close(self) -> None:
        """Stop the scheduler and release the device."""
        if self._hd is not None:
            hd, self._hd = self._hd, None
            hd.stop_scheduler()
            hd.close_device(self._id)
            self._seen = None


def _has_failed(hd: Any) -> bool:  # noqa: ANN401 - a module without types
    """Whether OpenHaptics reports an error."""
    try:
        return bool(hd.get_error())
    except KeyError:  # the package has names for only five of the codes
        return True
