"""Devices of Haply (Inverse3, Minverse) through the Haply Inverse Service on this machine.

Written from the documentation of the Inverse SDK 3.5 (docs.haply.co: "WebSocket Protocol", "Control
Commands", tutorials 01, 02 and 06). On connection the service sends the list of devices; after
that, exactly one state for each received message. Positions are in metres, velocities in m/s,
forces in N; x is right, y forward, z up. An optional VerseGrip gives the orientation and the
buttons. The Inverse3 has no motors for torque, so the torque is ignored. The angular velocity is
measured over 20 ms.
"""

import contextlib
import json
import math
import time
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.profiles import DeviceProfile
from hapticdb.devices.protocol import Reading
from hapticdb.devices.scripted import capped
from hapticdb.devices.vendors import VelocityWindow, load
from hapticdb.errors import DeviceError, UsageError
from hapticdb.poses import rotation_of

URL = "ws://localhost:10001"
LOOPBACK = {"localhost", "127.0.0.1", "::1"}

SILENCE = 0.1
"""Longest time to an answer, s; then the device counts as lost."""

AXES = ("x", "y", "z")


PROFILE = DeviceProfile("inverse3", cap=7.0, stiffness=1000.0, damping=5.0)
"""Profile of an Inverse3. Its maker gives no stiffness: common limits of desktop devices."""


class HaplyDevice:
    """A device of Haply.

    device_id : the service's name of the device ("049D"), the first one unless given; url : of the
    service, on this machine; profile : of the device, an Inverse3's unless given.

    Raises `UsageError` if the address is of another machine.
    """

    def __init__(
        self, device_id: str | None = None, *, url: str = URL, profile: DeviceProfile = PROFILE
    ) -> None:
        parts = urlsplit(url)
        if parts.scheme != "ws" or parts.hostname not in LOOPBACK:
            raise UsageError(f"the Haply service runs on this machine, as at {URL}, not at {url}")
        self.device_id = device_id
        self.url = url
        self.profile = profile
        self._socket: Any = None
        self._held = contextlib.ExitStack()
        self._exceptions: Any = None
        self._id = ""
        self._force = [0.0, 0.0, 0.0]
        self._n_awaited = 0
        self._rotation = np.eye(3)
        self._window = VelocityWindow()

    def open(self) -> None:
        """Connect to the service and find the device."""
        client = load("websockets.sync.client", "haply")
        self._exceptions = load("websockets.exceptions", "haply")
        try:
            # every message is answered within the period, so no pings; the service is local, so no
            # proxy
            connection = client.connect(
                self.url, open_timeout=2.0, close_timeout=0.5, ping_interval=None,
                compression=None, proxy=None,
            )  # fmt: skip
            self._socket = self._held.enter_context(connection)
        except (OSError, self._exceptions.WebSocketException) as error:
            raise DeviceError(
                f"no Haply Inverse Service at {self.url}: {error}; start the Haply Hub"
            ) from error
        try:
            self._id = self._find()
            self._window = VelocityWindow()
            named = {"configure": {"profile": {"name": "hapticdb"}}}
            self._send([0.0, 0.0, 0.0], session=named)
        except DeviceError:
            self.close()
            raise

    def _find(self) -> str:
        """Name of the device, from the list in the service's first message."""
        found = [each.get("device_id") for each in self._receive().get("inverse3", [])]
        if not found or self.device_id not in {None, *found}:
            which = "no Inverse3" if self.device_id is None else f"no Inverse3 {self.device_id}"
            names = ", ".join(map(str, found)) or "none"
            raise DeviceError(f"{which} at {self.url}; it has {names}; is it plugged in?")
        return str(self.device_id or found[0])

    def read(self) -> Reading:
        """Return pose, velocity and buttons from the service's answer to the last force."""
        if not self._n_awaited:  # the service only answers, so send the same force again
            self._send(self._force)
        state: dict[str, Any] = {}
        while self._n_awaited:
            state = self._receive()
            self._n_awaited -= 1
        return self._reading_of(state)

    def apply(self, wrench: NDArray[np.float64]) -> None:
        """Push with the force of a wrench (6,), N, capped; the torque is ignored."""
        self._send(capped(wrench, self.profile.cap, 0.0).tolist()[:3])

    def close(self) -> None:
        """Set the force to zero and disconnect."""
        if self._socket is not None:
            try:
                if self._id:
                    self._send([0.0, 0.0, 0.0])
            except DeviceError:
                pass  # the device is lost, so it pushes no more
            finally:
                self._socket, self._id, self._n_awaited = None, "", 0
                self._held.close()

    def _send(self, force: list[float], **more: object) -> None:
        vector = dict(zip(AXES, force, strict=True))
        command = {"device_id": self._id, "commands": {"set_cursor_force": {"vector": vector}}}
        socket = self._opened()
        try:
            socket.send(json.dumps({**more, "inverse3": [command]}))
        except (OSError, self._exceptions.WebSocketException) as error:
            raise self._lost(error) from error
        self._force = force
        self._n_awaited += 1

    def _receive(self) -> dict[str, Any]:
        socket = self._opened()
        try:
            state = json.loads(socket.recv(timeout=SILENCE))
        except (OSError, ValueError, self._exceptions.WebSocketException) as error:
            raise self._lost(error) from error
        if not isinstance(state, dict):
            raise self._lost("an answer of another form")
        return state

    def _opened(self) -> Any:  # noqa: ANN401 - of a package loaded late
        if self._socket is None:
            raise DeviceError("the Haply device is not open; call open() first")
        return self._socket

    def _lost(self, reason: object) -> DeviceError:
        said = str(reason) or "no answer in time"
        return DeviceError(f"the Haply device at {self.url} is gone: {said}; check the Haply Hub")

    def _reading_of(self, state: dict[str, Any]) -> Reading:
        mine = [each for each in state.get("inverse3", []) if each.get("device_id") == self._id]
        if not mine:
            raise self._lost(f"the service no longer lists {self._id}")
        pose = np.eye(4)
        try:
            pose[:3, 3] = _vector(mine[0]["state"]["cursor_position"])
            linear = _vector(mine[0]["state"]["cursor_velocity"])
        except (KeyError, TypeError, ValueError) as error:
            raise self._lost(f"a state without {error}") from error
        buttons = self._take_grip(state)
        pose[:3, :3] = self._rotation
        velocity = self._window.measure(time.perf_counter(), pose)
        velocity[:3] = linear
        return Reading(pose, velocity, buttons)

    def _take_grip(self, state: dict[str, Any]) -> int:
        """Store the orientation of the first VerseGrip, if there is one; return its buttons."""
        grips = state.get("wireless_verse_grip") or state.get("verse_grip") or [{}]
        grip = grips[0].get("state", {})
        q = grip.get("orientation", {})
        values = [float(q.get(name, 0.0)) for name in ("w", *AXES)]
        norm = math.hypot(*values)
        if norm > 0.5:  # a grip without a measurement yet reports zeros
            self._rotation = rotation_of([value / norm for value in values])[0]
        if "button" in grip:  # the wired grip has one button
            return int(bool(grip["button"]))
        held = grip.get("buttons", {})
        return sum(1 << bit for bit, name in enumerate(("a", "b", "c")) if held.get(name))


def _vector(named: dict[str, float]) -> list[float]:
    return [float(named[axis]) for axis in AXES]
