"""Stands in for `pyOpenHaptics` 1.0.1: `hd`, `hd_callback`, and a scheduler that a test drives."""

import ctypes
import sys
import threading
import time
from collections.abc import Callable
from types import ModuleType

import pytest

from children import joined

INVALID_HANDLE = 0xFFFFFFFF
Matrix = (ctypes.c_double * 4) * 4


class FakeHd(ModuleType):
    """One device; its state and force are usable only between `begin_frame` and `end_frame`."""

    def __init__(self) -> None:
        super().__init__("pyOpenHaptics.hd")
        self.handle: int | None = 7
        self.error: int = 0
        self.columns = [[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [10.0, 20.0, 30.0, 1.0]]
        self.buttons = 2
        self.calls: list[object] = []
        self.forces: list[list[float]] = []
        self.callback: Callable[[], None] | None = None
        self._in_frame = False
        self._is_running = False
        self._thread: threading.Thread | None = None

    def init_device(self, name: str = "Default Device") -> int | None:
        print("Unable to initialize the device. Check the connection!" * (self.handle is None))  # noqa: T201 - as it does
        self.calls.append(("init_device", name))
        return self.handle

    def enable_force(self) -> None:
        print("Force feedback enabled!")  # noqa: T201 - as it does
        self.calls.append("enable_force")

    def start_scheduler(self) -> None:
        self.calls.append("start_scheduler")
        self._is_running = True

    def stop_scheduler(self) -> None:
        self.calls.append("stop_scheduler")
        if self._thread is not None:
            self.unplug()

    def close_device(self, id: int) -> None:  # noqa: A002 - the package's name
        self.calls.append(("close_device", id))

    def get_error(self) -> bool:
        if self.error == 0:
            return False
        if self.error not in {0x0100, 0x0103, 0x0104, 0x0204, INVALID_HANDLE}:
            raise KeyError(self.error)
        print("InvalidOperationException: Error during the main scheduler.")  # noqa: T201 - as it does
        return True

    def get_transform(self) -> ctypes.Array[ctypes.Array[ctypes.c_double]]:
        assert self._in_frame
        matrix = Matrix()
        for column, values in zip(matrix, self.columns, strict=True):
            column[:] = values
        return matrix

    def get_buttons(self) -> int:
        assert self._in_frame
        return self.buttons

    def set_force(self, feedback: list[float]) -> None:
        assert self._in_frame
        x, y, z = feedback
        self.forces.append([x, y, z])

    def schedule(self, callback: Callable[[], None]) -> None:
        """Call a function a thousand times a second in a thread, as OpenHaptics does."""
        self.callback = callback
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Call the function no more; no call is under way afterwards."""
        self._is_running = False
        assert self._thread is not None
        joined(self._thread)

    def _run(self) -> None:
        assert self.callback is not None
        while self._is_running:
            self._in_frame = True
            self.callback()
            self._in_frame = False
            time.sleep(0.001)


def install(monkeypatch: pytest.MonkeyPatch) -> FakeHd:
    """Let `import pyOpenHaptics.hd` and `.hd_callback` find the fake."""
    hd = FakeHd()
    callbacks = ModuleType("pyOpenHaptics.hd_callback")
    callbacks.hd_callback = lambda function: function  # type: ignore[attr-defined]
    callbacks.hdAsyncSheduler = hd.schedule  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pyOpenHaptics", ModuleType("pyOpenHaptics"))
    monkeypatch.setitem(sys.modules, hd.__name__, hd)
    monkeypatch.setitem(sys.modules, callbacks.__name__, callbacks)
    return hd
