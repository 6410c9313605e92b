"""Connection between the server and its page process.

The page listens on a port of the loopback interface, open to every user of the machine. So the
server makes a secret for each page process and sends it in a header of each connection, along with
the browser's name and role. The page closes every connection without it.

Messages are words on an inherited socket pair, a line each.
"""

import contextlib
import hmac
import logging
import socket
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    import viser
    from numpy.typing import NDArray
    from viser.infra import Message, WebsockClientConnection
    from websockets.asyncio.server import ServerConnection

LOG = logging.getLogger("hapticdb.page")
SECRET, NAME, ROLE, SHOWN = (f"hapticdb-{word}" for word in ("secret", "name", "role", "shown"))
"""Headers of the server's connections to the page."""
ROLES = ("viewer", "toucher", "editor")
"""Roles; each includes the rights of those before it: to view, to touch, to move parts."""
PING, PONG, REFUSED = b"ping\n", b"pong\n", b"refused\n"
"""The server's question and its answer; a connection without the secret."""
LONGEST_WORDS = 200
"""Characters of a viser error in the log."""
LATE = 1013
"""WebSocket close code "try again later", for a connection without the secret."""
BREAKS_RULES = 1008
"""WebSocket close code "policy violation"."""
MOST_FAILED = 20
"""Messages that viser fails at, such as a text for a slider, before the connection is closed."""


class MachineFiles(NamedTuple):
    """Arguments of `read_machine`, a joint path, and the base's first pose (4, 4), metres."""

    machine: str
    srdf: str | None
    joints: str | None
    at: "NDArray[np.float64]"


class PageRequest(NamedTuple):
    """Arguments of the page process.

    urls : the environment's address for each role, whose rights the database enforces; tools :
    files, the first is the initial tool; tool_unit : as of `read_file`; server, host : descriptors
    of the sockets to the server (this module) and to the `SessionHost`; secret : of the server's
    connections; recordings : a folder, or None; is_direct : direct rendering for all hands, without
    virtual coupling.
    """

    urls: Mapping[str, str]
    tools: tuple[str, ...]
    server: int
    host: int
    secret: str
    recordings: str | None = None
    title: str = ""
    is_direct: bool = False
    machine: MachineFiles | None = None
    tool_unit: str | None = None


class Visitor(NamedTuple):
    """Person at a browser: displayed name, role, and ids of the parts that the link shows."""

    name: str
    role: str
    shown: tuple[int, ...] = ()

    def may(self, role: str) -> bool:
        """Whether the visitor has at least this role."""
        return ROLES.index(self.role) >= ROLES.index(role)


class PageConnection:
    """The page's end of the inherited socket; admits connections of the server alone."""

    def __init__(self, descriptor: int, secret: str) -> None:
        self._socket = socket.socket(fileno=descriptor)
        self._secret = secret.encode()
        self._live: Mapping[int, ServerConnection] = {}
        self._thread = threading.Thread(target=self._listen, name="server", daemon=True)
        self._thread.start()

    def guard(self, server: "viser.ViserServer") -> None:
        """Close connections without the secret, or with too many bad messages.

        A message that viser fails at is one line of the log, whatever viser raises.
        """
        inner = server._websock_server  # noqa: SLF001 - viser shows connections nowhere else
        live = self._live = inner._live_connections  # noqa: SLF001 - likewise
        nonsense = _Nonsense(live)

        async def check(connection: "WebsockClientConnection") -> None:
            client = int(connection.client_id)
            try:
                self.visitor(client)
            except KeyError:
                self.send(REFUSED)
                await live[client].close(LATE, "connect through the server")
            nonsense.contain(connection)

        def leave(connection: "WebsockClientConnection") -> None:
            nonsense.forget(int(connection.client_id))

        nonsense.contain(inner)
        inner.on_client_connect(check)
        inner.on_client_disconnect(leave)

    def visitor(self, client_id: int) -> Visitor:
        """Visitor of a client; KeyError without a connection or without the secret."""
        request = self._live[client_id].request
        assert request is not None  # noqa: S101 - the handshake is over
        # all headers joined: a second one from the browser must not hide behind the server's
        shown = "".join(request.headers.get_all(SECRET)).encode(errors="replace")
        # constant time: any user of the machine can try on the loopback interface
        if not hmac.compare_digest(shown, self._secret):
            raise KeyError(client_id)
        ids = tuple(int(i) for i in request.headers.get(SHOWN, "").split(",") if i)
        return Visitor(request.headers[NAME], request.headers[ROLE], ids)

    def send(self, word: bytes) -> None:
        """Send a message to the server; ignored if the server has ended."""
        with contextlib.suppress(OSError):
            self._socket.sendall(word)

    def _listen(self) -> None:
        with contextlib.suppress(ConnectionError), self._socket.makefile("rb") as stream:
            for received in stream:
                if received == PING:
                    self.send(PONG)


class _Nonsense:
    """Messages that viser fails at: one log line each; `MOST_FAILED` close a connection."""

    def __init__(self, connections: Mapping[Any, Any]) -> None:
        self._connections = connections
        self._failed: dict[int, int] = {}

    def contain(self, handler: Any) -> None:  # noqa: ANN401 - the server, or a connection
        """Wrap viser's message handler: no exception leaves it."""
        handle = handler._handle_incoming_message  # noqa: SLF001 - viser shows it nowhere else

        async def handled(client_id: int, message: "Message") -> None:
            try:
                await handle(client_id, message)
            except Exception as error:  # noqa: BLE001 - viser checks little of what it is sent
                await self._fail(int(client_id), message, error)

        handler._handle_incoming_message = handled  # noqa: SLF001 - likewise

    def forget(self, client: int) -> None:
        """Drop a client's count after it has disconnected."""
        self._failed.pop(client, None)

    async def _fail(self, client: int, message: "Message", error: Exception) -> None:
        live = self._connections.get(client)
        failed = self._failed.get(client, 0) + 1
        if live is None or failed > MOST_FAILED:
            return  # disconnected, or closing
        self._failed[client] = failed
        words = " ".join(f"{type(error).__name__}: {error}".split())[:LONGEST_WORDS]
        LOG.warning("a browser's %s cannot be taken in: %s", type(message).__name__, words)
        if failed == MOST_FAILED:
            await live.close(BREAKS_RULES, "too many messages that mean nothing here")
