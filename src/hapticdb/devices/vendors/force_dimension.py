"""Devices of Force Dimension (omega, delta, sigma, lambda, Novint Falcon).

Written from the documentation and the sources of `forcedimension-core` 1.0.0, which calls the Force
Dimension SDK 3.16 or later. The functions of `forcedimension_core.dhd` write into their arguments
and return 0 or more on success, -1 on failure. The SDK itself comes from the vendor.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.profiles import DeviceProfile
from hapticdb.devices.protocol import Reading
from hapticdb.devices.scripted import capped
from hapticdb.devices.vendors import load
from hapticdb.errors import DeviceError

TIMEOUT = 7
"""ErrorNum.TIMEOUT: the velocity estimator does not have two positions yet."""
PROFILE = DeviceProfile("force-dimension", cap=7.0, stiffness=3000.0, damping=20.0)
"""Profile of an unspecified model: limits within those of every model."""


class ForceDimensionDevice:
    """A device of Force Dimension; its frame is that of its manual.

    Without a wrist its rotation is the identity; without motors in the wrist the torque is ignored.

    serial : number; the first free device unless given; profile : the model's, as of
    `hapticdb.devices.profiles.PROFILES`.
    """

    def __init__(self, serial: int | None = None, *, profile: DeviceProfile = PROFILE) -> None:
        self.serial = serial
        self._torque_cap = profile.torque_cap or 0.2
        self.profile = replace(profile, torque_cap=self._torque_cap)
        self._dhd: Any = None
        self._id = -1
        self._has_wrist = self._has_active_wrist = False

    def open(self) -> None:
        """Open the device and enable its motors."""
        dhd = load("forcedimension_core.dhd", "force-dimension")
        self._id = dhd.open() if self.serial is None else dhd.openSerial(self.serial)
        if self._id < 0:
            name = "" if self.serial is None else f" with serial number {self.serial}"
            raise DeviceError(
                f"no Force Dimension device{name}: {dhd.errorGetLastStr()}; is it plugged in?"
            )
        self._dhd = dhd
        self._has_wrist = bool(dhd.hasWrist(ID=self._id))
        self._has_active_wrist = bool(dhd.hasActiveWrist(ID=self._id))
        self._check(dhd.enableForce(True, ID=self._id))  # noqa: FBT003 - the SDK's own order

    def read(self) -> Reading:
        """Return pose, velocity and buttons now."""
        dhd = self._opened()
        pose, velocity = np.eye(4), np.zeros(6)
        if self._has_wrist:
            rows = pose[:3, :3]
            self._check(dhd.getPositionAndOrientationFrame(pose[:3, 3], rows, ID=self._id))
            self._check_velocity(dhd.getAngularVelocityRad(velocity[3:], ID=self._id))
        else:
            self._check(dhd.getPosition(pose[:3, 3], ID=self._id))
        self._check_velocity(dhd.getLinearVelocity(velocity[:3], ID=self._id))
        return Reading(pose, velocity, int(dhd.getButtonMask(ID=self._id)))

    def apply(self, wrench: NDArray[np.float64]) -> None:
        """Push with a wrench (6,), N and N m, capped."""
        dhd = self._opened()
        push: list[float] = capped(wrench, self.profile.cap, self._torque_cap).tolist()
        if self._has_active_wrist:
            self._check(dhd.setForceAndTorque(push[:3], push[3:], ID=self._id))
        else:
            self._check(dhd.setForce(push[:3], ID=self._id))

    def close(self) -> None:
        """Stop the motors and release the device."""
        if self._dhd is not None:
            dhd, self._dhd = self._dhd, None
            dhd.stop(ID=self._id)
            dhd.close(ID=self._id)

    def _opened(self) -> Any:  # noqa: ANN401 - a module without types
        if self._dhd is None:
            raise DeviceError("the Force Dimension device is not open; call open() first")
        return self._dhd

    def _check(self, code: int) -> None:
        if code < 0:  # 1 (no news within the time guard) and 2 (motors saturated) are successes
            raise DeviceError(
                f"the Force Dimension device failed: {self._dhd.errorGetLastStr()};"
                " check its cable and power"
            )

    def _check_velocity(self, code: int) -> None:
        if code < 0 and self._dhd.errorGetLast() != TIMEOUT:
            self._check(code)
