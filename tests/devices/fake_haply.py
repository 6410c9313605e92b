"""Stands in for the Haply Inverse Service 3.5: a WebSocket server on loopback."""

import json
import threading
from types import TracebackType
from typing import Any, Self

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from children import joined

IDENTITY = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}


def vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


class FakeHaply:
    """Sends all devices on connection, then one state for each message; records the messages."""

    def __init__(self) -> None:
        self.devices = ["049D"]
        self.position, self.velocity = vector(0.0, -0.12, 0.15), vector(0.0, 0.0, 0.0)
        self.grips: dict[str, list[dict[str, Any]]] = {}
        self.told: list[dict[str, Any]] = []
        self.answers = True
        self.is_over = threading.Event()
        self._connections: list[ServerConnection] = []

    def __enter__(self) -> Self:
        self._server = serve(self._serve, "127.0.0.1", 0, compression=None)
        port = self._server.socket.getsockname()[1]
        self.url = f"ws://127.0.0.1:{port}"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.unplug()
        self._server.shutdown()
        joined(self._thread)

    def unplug(self) -> None:
        """End every connection, as when the service stops."""
        for connection in self._connections:
            connection.close()

    @property
    def forces(self) -> list[dict[str, float]]:
        """Every force that was sent to the device."""
        return [
            message["inverse3"][0]["commands"]["set_cursor_force"]["vector"]
            for message in self.told
        ]

    def _state(self) -> dict[str, Any]:
        state = {"cursor_position": self.position, "cursor_velocity": self.velocity}
        return {
            "inverse3": [{"device_id": name, "state": state} for name in self.devices],
            **self.grips,
        }

    def _serve(self, connection: ServerConnection) -> None:
        self._connections.append(connection)
        first = self._state()
        for each in first["inverse3"]:
            each |= {"config": {"type": "inverse3"}, "status": {"ready": True}}
        try:
            connection.send(json.dumps({"session_id": 7, **first}))
            for message in connection:
                self.told.append(json.loads(message))
                if self.answers:
                    connection.send(json.dumps(self._state()))
        except ConnectionClosed:
            pass
        self.is_over.set()
