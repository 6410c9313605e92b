"""Vendors' devices, each against a fake of the interface that its vendor documents."""

import math
import pickle
import sys
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import TypeVar

import numpy as np
import pytest

from children import TIMEOUT, until
from devices.fake_dhd import FakeDhd
from devices.fake_dhd import install as install_dhd
from devices.fake_haply import IDENTITY, FakeHaply, vector
from devices.fake_hd import INVALID_HANDLE, FakeHd
from devices.fake_hd import install as install_hd
from hapticdb.devices.protocol import Device, SupportsClose, SupportsOpen
from hapticdb.devices.vendors import VelocityWindow, load, openhaptics
from hapticdb.devices.vendors import haply as haply_module
from hapticdb.devices.vendors.force_dimension import ForceDimensionDevice
from hapticdb.devices.vendors.haply import HaplyDevice
from hapticdb.devices.vendors.openhaptics import OpenHapticsDevice
from hapticdb.errors import DeviceError, MissingExtraError, UsageError

PUSH = np.array([30.0, 0.0, 40.0, 0.0, 3.0, 0.0])


@pytest.fixture
def dhd(monkeypatch: pytest.MonkeyPatch) -> FakeDhd:
    return install_dhd(monkeypatch)


@pytest.fixture
def hd(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeHd]:
    monkeypatch.setattr(openhaptics, "SILENCE", TIMEOUT)  # a busy machine is no silent device
    fake = install_hd(monkeypatch)
    yield fake
    fake.stop_scheduler()


@pytest.fixture
def haply(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeHaply]:
    monkeypatch.setattr(haply_module, "SILENCE", TIMEOUT)
    with FakeHaply() as fake:
        yield fake


D = TypeVar("D", bound=SupportsOpen)


def opened(device: D) -> D:
    device.open()
    return device


# --- all of them --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "package", "wanted"),
    [
        (ForceDimensionDevice, "forcedimension_core", "forcedimension-core"),
        (OpenHapticsDevice, "pyOpenHaptics", "pyopenhaptics"),
        (HaplyDevice, "websockets", "websockets"),
    ],
)
def test_device_missing_package(
    monkeypatch: pytest.MonkeyPatch, make: Callable[[], SupportsOpen], package: str, wanted: str
) -> None:
    for name in [n for n in sys.modules if n.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Without(package), *sys.meta_path])
    with pytest.raises(MissingExtraError, match=rf"{package}.*pip install .*{wanted}"):
        make().open()


class Without:
    """An import finder that makes one package look missing."""

    def __init__(self, package: str) -> None:
        self.package = package

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        del path, target
        if name.partition(".")[0] == self.package:
            raise ModuleNotFoundError(f"No module named {name!r}", name=self.package)


def test_load_vendor_library_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(name: str) -> ModuleType:
        raise OSError(f"libHD.so: cannot open shared object file\n{name}")

    monkeypatch.setattr("hapticdb.devices.vendors.importlib.import_module", fail)
    with pytest.raises(DeviceError, match=r"libHD\.so") as caught:
        load("pyOpenHaptics.hd", "openhaptics")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("make", [ForceDimensionDevice, OpenHapticsDevice, HaplyDevice])
def test_devices_pickle_before_open(make: Callable[[], Device]) -> None:
    device = make()
    assert isinstance(device, SupportsOpen)
    assert isinstance(device, SupportsClose)
    device.close()
    with pytest.raises(DeviceError, match="not open"):
        pickle.loads(pickle.dumps(device)).read()  # noqa: S301 - its own


def test_velocity_window_difference() -> None:
    window = VelocityWindow()
    pose = np.eye(4)
    assert window.measure(5.0, pose.copy()).tolist() == [0.0] * 6
    for n in range(1, 60):
        angle = 2.0 * n * 0.001
        pose[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        pose[1, 3] = 0.3 * n * 0.001
        velocity = window.measure(5.0 + n * 0.001, pose.copy())
        assert np.allclose(velocity, [0, 0.3, 0, 0, 0, 2.0], atol=1e-6)
    for n in range(60, 90):  # the hand stops; 20 ms later its velocity is zero
        velocity = window.measure(5.0 + n * 0.001, pose.copy())
    assert velocity.tolist() == [0.0] * 6


# --- Force Dimension ----------------------------------------------------------------------------


def test_force_dimension_pose_velocity_buttons(dhd: FakeDhd) -> None:
    device = opened(ForceDimensionDevice())
    reading = device.read()
    assert reading.pose[:3, 3].tolist() == [0.01, 0.02, 0.03]
    assert reading.pose[:3, :3].tolist() == dhd.rows
    assert reading.pose[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert reading.velocity.tolist() == [0.1, 0.2, 0.3, 1.0, 2.0, 3.0]
    assert reading.buttons == 5
    assert dhd.calls[:2] == [("open",), ("enableForce", True, 0)]


def test_force_dimension_caps(dhd: FakeDhd) -> None:
    device = opened(ForceDimensionDevice(4711))
    assert dhd.calls[0] == ("openSerial", 4711)
    device.apply(PUSH)
    force, torque = pytest.approx([4.2, 0.0, 5.6]), pytest.approx([0.0, 0.2, 0.0])
    assert dhd.calls[-1] == ("setForceAndTorque", force, torque, 0)


def test_force_dimension_without_wrist(dhd: FakeDhd) -> None:
    dhd.wrist = dhd.active_wrist = False
    device = opened(ForceDimensionDevice())
    reading = device.read()
    assert np.array_equal(reading.pose[:3, :3], np.eye(3))
    assert reading.pose[:3, 3].tolist() == dhd.position
    assert reading.velocity.tolist() == [0.1, 0.2, 0.3, 0.0, 0.0, 0.0]
    device.apply(PUSH)
    assert dhd.calls[-1] == ("setForce", pytest.approx([4.2, 0.0, 5.6]), 0)


def test_force_dimension_tolerates_soft_error_codes(
    dhd: FakeDhd,
) -> None:
    dhd.velocity_code, dhd.push_code = -1, 2
    device = opened(ForceDimensionDevice())
    assert device.read().velocity.tolist() == [0.0] * 6
    device.apply(PUSH)
    assert dhd.calls[-1][0] == "setForceAndTorque"


def test_force_dimension_missing_device(dhd: FakeDhd) -> None:
    dhd.n_devices = 0
    with pytest.raises(DeviceError, match="no device found"):
        ForceDimensionDevice().open()
    with pytest.raises(DeviceError, match="serial number 12: no device found"):
        ForceDimensionDevice(12).open()


def test_force_dimension_unplugged(dhd: FakeDhd) -> None:
    device = opened(ForceDimensionDevice())
    dhd.is_plugged = False
    with pytest.raises(DeviceError, match="communication error"):
        device.read()
    with pytest.raises(DeviceError, match="communication error"):
        device.apply(PUSH)
    dhd.is_plugged = True
    for _ in range(2):
        device.close()
    assert dhd.calls[-2:] == [("stop", 0), ("close", 0)]


# --- OpenHaptics --------------------------------------------------------------------------------


def test_openhaptics_pose_conversion(hd: FakeHd, capsys: pytest.CaptureFixture[str]) -> None:
    device = opened(OpenHapticsDevice("Left"))
    reading = device.read()
    assert np.allclose(reading.pose[:3, 3], [0.01, 0.02, 0.03])
    assert reading.pose[:3, 1].tolist() == [0.0, 0.0, 1.0]  # the second column
    assert reading.pose[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert reading.buttons == 2
    assert hd.calls[:3] == [("init_device", "Left"), "enable_force", "start_scheduler"]
    device.close()
    assert hd.calls[3:] == ["stop_scheduler", ("close_device", 7)]
    assert capsys.readouterr().out == ""


def test_openhaptics_capped_force(hd: FakeHd) -> None:
    device = opened(OpenHapticsDevice())
    assert set(map(tuple, hd.forces)) == {(0.0, 0.0, 0.0)}

    def is_pushed() -> bool:
        device.apply(PUSH)
        return bool(np.allclose(hd.forces[-1], [1.98, 0.0, 2.64]))

    until(is_pushed)
    device.close()


def test_openhaptics_force_times_out(hd: FakeHd) -> None:
    now = [0.0]
    device = opened(OpenHapticsDevice(clock=lambda: now[0]))
    device.apply(PUSH)
    until(lambda: hd.forces[-1] != [0.0, 0.0, 0.0])
    now[0] = 0.06
    until(lambda: hd.forces[-1] == [0.0, 0.0, 0.0])
    device.close()


@pytest.mark.parametrize("handle", [None, INVALID_HANDLE])
def test_openhaptics_missing_device(hd: FakeHd, handle: int | None) -> None:
    hd.handle = handle
    with pytest.raises(DeviceError, match="no OpenHaptics device named 'Default Device'"):
        OpenHapticsDevice().open()
    assert "start_scheduler" not in hd.calls


@pytest.mark.parametrize("code", [0x0103, 0x0302])
def test_openhaptics_start_failure_releases_device(hd: FakeHd, code: int) -> None:
    hd.error = code  # one code has a name in the package, the other has none
    with pytest.raises(DeviceError, match="failed to start"):
        OpenHapticsDevice().open()
    assert hd.calls[-2:] == ["stop_scheduler", ("close_device", 7)]


def test_openhaptics_silent_device(hd: FakeHd) -> None:
    now = [0.0]
    device = opened(OpenHapticsDevice(clock=lambda: now[0]))
    hd.unplug()
    device.read()
    now[0] = TIMEOUT + 0.1
    with pytest.raises(DeviceError, match="silent"):
        device.read()
    device.close()


# --- Haply --------------------------------------------------------------------------------------


def test_haply_reading_of_service(haply: FakeHaply) -> None:
    haply.velocity = vector(0.1, 0.2, 0.3)
    device = opened(HaplyDevice(url=haply.url))
    reading = device.read()
    assert reading.pose[:3, 3].tolist() == [0.0, -0.12, 0.15]
    assert np.array_equal(reading.pose[:3, :3], np.eye(3))
    assert reading.velocity.tolist() == [0.1, 0.2, 0.3, 0.0, 0.0, 0.0]
    assert reading.buttons == 0
    assert haply.told[0]["session"] == {"configure": {"profile": {"name": "hapticdb"}}}
    device.close()


def test_haply_sends_capped_forces_only(haply: FakeHaply) -> None:
    device = opened(HaplyDevice("049D", url=haply.url))
    for _ in range(3):
        device.read()
        device.apply(PUSH)
    device.read()
    device.close()
    assert haply.is_over.wait(TIMEOUT)
    push = {"x": pytest.approx(4.2), "y": 0.0, "z": pytest.approx(5.6)}
    assert haply.forces == [vector(0, 0, 0), push, push, push, vector(0, 0, 0)]
    assert all(message["inverse3"][0]["device_id"] == "049D" for message in haply.told)
    assert all("session" not in message for message in haply.told[1:])


def test_haply_newest_state(haply: FakeHaply) -> None:
    device = opened(HaplyDevice(url=haply.url))
    for n in range(5):
        device.apply(PUSH)
        haply.position = vector(0.01 * n, 0.0, 0.0)
    device.read()  # reads all answers so far
    haply.position = vector(0.5, 0.0, 0.0)
    assert device.read().pose[0, 3] == 0.5
    assert haply.forces[-1] == haply.forces[-2] != vector(0, 0, 0)
    device.close()


@pytest.mark.parametrize(
    ("kind", "state", "buttons"),
    [
        ("wireless_verse_grip", {"buttons": {"a": True, "b": False, "c": True}}, 5),
        ("verse_grip", {"button": True, "hall": 3}, 1),
    ],
)
def test_haply_grip_orientation_and_buttons(
    haply: FakeHaply, kind: str, state: dict[str, object], buttons: int
) -> None:
    half = math.sqrt(0.5)
    turned = {"w": half, "x": 0.0, "y": 0.0, "z": half}
    haply.grips = {kind: [{"device_id": "61548", "state": {"orientation": turned, **state}}]}
    device = opened(HaplyDevice(url=haply.url))
    reading = device.read()
    assert np.allclose(reading.pose[:3, 0], [0.0, 1.0, 0.0])
    assert reading.buttons == buttons
    haply.grips[kind][0]["state"]["orientation"] = dict.fromkeys(IDENTITY, 0.0)
    assert np.allclose(device.read().pose[:3, 0], [0.0, 1.0, 0.0])  # zeros are no rotation
    device.close()


def test_haply_missing_device(haply: FakeHaply) -> None:
    with pytest.raises(DeviceError, match=r"no Inverse3 XY at .* it has 049D"):
        HaplyDevice("XY", url=haply.url).open()
    haply.devices = []
    with pytest.raises(DeviceError, match=r"no Inverse3 at .* it has none"):
        HaplyDevice(url=haply.url).open()


def test_haply_missing_service(haply: FakeHaply) -> None:
    url = haply.url
    haply.__exit__(None, None, None)
    with pytest.raises(DeviceError, match="no Haply Inverse Service") as caught:
        HaplyDevice(url=url).open()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("stops", [False, True])
def test_haply_silent_or_stopped_service(
    haply: FakeHaply, stops: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = opened(HaplyDevice(url=haply.url))
    device.read()
    if stops:
        haply.unplug()
    haply.answers = False
    monkeypatch.setattr(haply_module, "SILENCE", 0.1)
    with pytest.raises(DeviceError, match="is gone"):
        device.read()
    if stops:
        with pytest.raises(DeviceError, match="is gone"):
            device.apply(PUSH)
    device.close()


def test_haply_url_local_only() -> None:
    for url in ("ws://192.0.2.1:10001", "wss://localhost:10001"):
        with pytest.raises(UsageError, match="on this machine"):
            HaplyDevice(url=url)
