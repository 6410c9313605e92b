"""One connection to a server's contact endpoint, its opening and its messages."""

import socket
from contextlib import suppress
from typing import TYPE_CHECKING

from hapticdb.client.opening import open_websocket, parse_address
from hapticdb.errors import (
    ConnectionLostError,
    ProtocolError,
    UsageError,
)
from hapticdb.protocol.contacts import (
    HandState,
    ProxyState,
    ProxyTerms,
    ProxyWish,
    pack_hand,
    pack_wish,
    unpack_proxy,
    unpack_terms,
)

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

GRANTED_WITHIN = 180.0
"""Seconds in which a server that has answered must grant a tool: the first client's cells and tools
are made then, and at a server's first start its kernels. Larger: a server that hangs is noticed
later."""


class ContactConnection:
    """A connection that has been granted a tool, on these terms; it is owned."""

    def __init__(self, connection: "ClientConnection", terms: ProxyTerms) -> None:
        self._connection, self.terms = connection, terms

    def receive(self) -> tuple[ProxyState, int]:
        """Wait for the next proxy; returns it and its size in bytes.

        ConnectionLostError with the server's reason if the connection has ended, ProtocolError if
        the message is malformed.
        """
        message = _received(self._connection, None)
        return unpack_proxy(message), len(message)

    def send(self, hand: HandState) -> None:
        """Send a hand; ConnectionLostError if the connection has ended."""
        _send(self._connection, pack_hand(hand))

    def close(self) -> None:
        """Disconnect at once: a server that is frozen is not waited for."""
        with suppress(OSError):
            self._connection.socket.shutdown(socket.SHUT_RDWR)
        with suppress(OSError):
            self._connection.close()


def connect(url: str, wish: ProxyWish, patience: float) -> ContactConnection:
    """Connect to a server and ask for a tool; `ContactProxy` names the errors.

    patience : seconds in which it must answer; it must grant a tool within `GRANTED_WITHIN`.
    """
    connection = open_websocket(parse_address(url), patience)
    try:
        _send(connection, pack_wish(wish))
        return ContactConnection(connection, unpack_terms(_received(connection, GRANTED_WITHIN)))
    except BaseException:
        connection.close()
        raise


def _send(connection: "ClientConnection", message: bytes) -> None:
    from websockets.exceptions import ConnectionClosed  # noqa: PLC0415 - an extra

    try:
        connection.send(message)
    except (ConnectionClosed, OSError) as error:
        raise ConnectionLostError(f"the server is gone: {error}") from error


def _received(connection: "ClientConnection", patience: float | None) -> bytes:
    """Wait for the next binary message."""
    from websockets.exceptions import ConnectionClosed  # noqa: PLC0415 - an extra

    try:
        message = connection.recv(patience)
    except ConnectionClosed as error:
        frame = error.rcvd
        if frame is not None and frame.reason:
            if 4000 <= frame.code < 4500:
                raise UsageError(f"the server refuses: {frame.reason}") from None
            raise ConnectionLostError(f"the server ends: {frame.reason}") from None
        raise ConnectionLostError("the connection to the server is lost") from None
    except TimeoutError:
        raise ConnectionLostError("the server does not answer: connect again") from None
    except OSError as error:
        raise ConnectionLostError(f"the connection to the server is lost: {error}") from error
    if isinstance(message, str):
        raise ProtocolError("a text message, where a binary one must come")
    return message
