"""A person at the page without a browser: reads what the page sends, and presses its widgets."""

import contextlib
import time
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.connection import Connection

from children import until
from serving import CAMERA, messages, sent


class PagePerson:
    """Knows the widgets of one connection to the page by their labels.

    connection : as `serving.Running.browser` makes it.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self.widgets: dict[str, dict[str, Any]] = {}
        self.told: list[str] = []
        self.received: list[str] = []
        sent(connection, CAMERA)

    def look(self, seconds: float = 0.2) -> bool:
        """Take in what the page sends for a time; returns whether the page has told something."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            with contextlib.suppress(TimeoutError):
                for one in messages(self._connection, left):
                    self._take(one)
        return bool(self.told)

    def _take(self, message: dict[str, Any]) -> None:
        kind, uuid = str(message["type"]), message.get("uuid")
        if kind.startswith("Gui") or "Notification" in kind:
            self.received.append(str(message))
        if kind == "GuiUpdateMessage" and uuid in self.widgets:
            self.widgets[uuid].update(message["updates"])
        elif kind.startswith("Gui") and isinstance(message.get("props"), dict) and uuid:
            self.widgets[uuid] = {**message["props"], "value": message.get("value")}
        elif "Notification" in kind:
            self.told.append(str(message))

    def wait_for(self, words: str) -> None:
        until(lambda: (self.look(0.05), any(words in text for text in self.received))[1])

    def find(self, label: str, option: str = "") -> str:
        """Id of the widget with that label, or of a group with that option, once it is sent."""
        found: list[str] = []

        def is_there() -> bool:
            self.look(0.05)
            found[:] = [
                u
                for u, one in self.widgets.items()
                if one.get("label") == label and (not option or option in one["options"])
            ]
            return bool(found)

        until(is_there)
        return found[0]

    def press(self, label: str) -> None:
        self.put(self.find(label), value=True)

    def choose(self, label: str, value: object) -> None:
        """Choose a value of a widget, such as a button of a group."""
        self.put(self.find(label), value=value)

    def put(self, uuid: str, value: object) -> None:
        """Send a value of a widget, whatever it is."""
        update = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
        sent(self._connection, update)

    def put_everything(self) -> None:
        """Send every widget many values, as a client of one's own can."""
        values = (True, False, 1.0, -1, "", "Take out", "Put back", [0.0, 0.0, 0.1], None)
        with contextlib.suppress(ConnectionClosed):
            for uuid in list(self.widgets):
                for value in values:
                    self.put(uuid, value)
                    self.look(0.01)
