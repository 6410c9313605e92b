"""Stands in for `forcedimension_core.dhd` 1.0.0: its calls, argument forms and return codes."""

# ruff: noqa: N802, N803 - the SDK's names

import sys
from collections.abc import MutableSequence, Sequence
from types import ModuleType

import pytest

NO_DEVICE_FOUND, COM, TIMEOUT = 5, 2, 7
SAID = {0: "no error", NO_DEVICE_FOUND: "no device found", COM: "communication error"}


class FakeDhd(ModuleType):
    """One device at a set position; it records the calls it gets."""

    def __init__(self) -> None:
        super().__init__("forcedimension_core.dhd")
        self.n_devices = 1
        self.serials = {4711: 0}
        self.is_plugged = True
        self.wrist = True
        self.active_wrist = True
        self.position = [0.01, 0.02, 0.03]
        self.rows = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
        self.linear = [0.1, 0.2, 0.3]
        self.angular = [1.0, 2.0, 3.0]
        self.velocity_code = 0
        self.mask = 5
        self.push_code = 0
        self.error = 0
        self.calls: list[tuple[object, ...]] = []

    def _code(self, *call: object) -> int:
        self.calls.append(call)
        if not self.is_plugged:
            self.error = COM
            return -1
        return 0

    def errorGetLast(self) -> int:
        return self.error

    def errorGetLastStr(self) -> str:
        return SAID[self.error]

    def open(self) -> int:
        if not self.n_devices:
            self.error = NO_DEVICE_FOUND
            return -1
        return self._code("open")

    def openSerial(self, serial: int) -> int:
        if serial not in self.serials:
            self.error = NO_DEVICE_FOUND
            return -1
        return self._code("openSerial", serial)

    def close(self, ID: int = -1) -> int:
        return self._code("close", ID)

    def stop(self, ID: int = -1) -> int:
        return self._code("stop", ID)

    def enableForce(self, enable: bool, ID: int = -1) -> int:
        return self._code("enableForce", enable, ID)

    def hasWrist(self, ID: int = -1) -> bool:
        assert ID == 0
        return self.wrist

    def hasActiveWrist(self, ID: int = -1) -> bool:
        assert ID == 0
        return self.active_wrist

    def getPosition(self, out: MutableSequence[float], ID: int = -1) -> int:
        out[0], out[1], out[2] = self.position
        return self._code("getPosition", ID)

    def getPositionAndOrientationFrame(
        self, p_out: MutableSequence[float], matrix_out: Sequence[MutableSequence[float]], ID: int
    ) -> int:
        p_out[0], p_out[1], p_out[2] = self.position
        for i in range(3):
            for j in range(3):
                matrix_out[i][j] = self.rows[i][j]
        return self._code("getPositionAndOrientationFrame", ID)

    def _velocity(self, out: MutableSequence[float], values: list[float], *call: object) -> int:
        if self.velocity_code < 0:
            self.error = TIMEOUT
            return self.velocity_code
        out[0], out[1], out[2] = values
        return self._code(*call)

    def getLinearVelocity(self, out: MutableSequence[float], ID: int = -1) -> int:
        return self._velocity(out, self.linear, "getLinearVelocity", ID)

    def getAngularVelocityRad(self, out: MutableSequence[float], ID: int = -1) -> int:
        return self._velocity(out, self.angular, "getAngularVelocityRad", ID)

    def getButtonMask(self, ID: int = -1) -> int:
        self.calls.append(("getButtonMask", ID))
        return self.mask

    def setForce(self, f: Sequence[float], ID: int = -1) -> int:
        return self._code("setForce", [f[0], f[1], f[2]], ID) or self.push_code

    def setForceAndTorque(self, f: Sequence[float], t: Sequence[float], ID: int = -1) -> int:
        code = self._code("setForceAndTorque", [f[0], f[1], f[2]], [t[0], t[1], t[2]], ID)
        return code or self.push_code


def install(monkeypatch: pytest.MonkeyPatch) -> FakeDhd:
    """Let `import forcedimension_core.dhd` find the fake."""
    fake = FakeDhd()
    monkeypatch.setitem(sys.modules, "forcedimension_core", ModuleType("forcedimension_core"))
    monkeypatch.setitem(sys.modules, fake.__name__, fake)
    return fake
