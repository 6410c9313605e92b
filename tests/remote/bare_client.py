"""A client of the endpoint for cells: a socket, and the protocol of websockets without threads."""

import socket
from collections import deque

from websockets.client import ClientProtocol
from websockets.frames import Frame, Opcode
from websockets.uri import parse_uri

from children import PATIENCE
from hapticdb.protocol.header import Kind, MessageHeader, header_of


class BareClient:
    """Connects and greets.

    Attributes
    ----------
    close_code, close_reason
        What the server said at the end; None and empty before it.
    """

    def __init__(self, address: str) -> None:
        uri = parse_uri(address)
        self._socket = socket.create_connection((uri.host, uri.port), PATIENCE)
        self._protocol = ClientProtocol(uri, max_size=None)
        self._arrived: deque[Frame] = deque()
        self._protocol.send_request(self._protocol.connect())
        self._flush()
        self._read()
        if self._protocol.handshake_exc is not None:
            self.close()
            raise self._protocol.handshake_exc
        self.send(MessageHeader(Kind.HELLO, 1).packed())
        welcome = self.receive()
        assert welcome is not None
        assert header_of(welcome).kind == Kind.WELCOME

    @property
    def close_code(self) -> int | None:
        return self._protocol.close_code

    @property
    def close_reason(self) -> str:
        return self._protocol.close_reason or ""

    def send(self, *messages: bytes) -> None:
        """Send messages; nothing after the connection's end."""
        for message in messages:
            self._protocol.send_binary(message)
        self._flush()

    def receive(self) -> bytes | None:
        """Next message; None at the connection's end."""
        while not self._arrived:
            if not self._read():
                return None
        return bytes(self._arrived.popleft().data)

    def _read(self) -> bool:
        data = self._socket.recv(1 << 16)
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        events = [one for one in self._protocol.events_received() if isinstance(one, Frame)]
        self._arrived += [one for one in events if one.opcode is Opcode.BINARY]
        self._flush()
        return bool(data) or bool(self._arrived)

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            if data:
                self._socket.sendall(data)

    def close(self) -> None:
        """End the connection without a word."""
        self._socket.close()
