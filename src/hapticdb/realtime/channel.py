"""Channel: pickled messages between processes of our own, with file descriptors beside them.

The processes trust one another: one of them started the others, and the socket between them is a
pair that has no name. Nothing of a client from outside goes through a channel unparsed.
"""

import contextlib
import pickle
import socket
from collections.abc import Sequence
from typing import Any

MOST_DESCRIPTORS = 16
"""Most file descriptors beside one message."""
HEADER = 8
"""Bytes of a message's length."""


class Channel:
    """Messages over one end of a pair of sockets of the family AF_UNIX, which it owns."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock

    def send(self, content: object, descriptors: Sequence[int] = ()) -> None:
        """Send a message, and file descriptors with it."""
        packed = pickle.dumps(content)
        whole = len(packed).to_bytes(HEADER, "little") + packed
        sent = socket.send_fds(self.sock, [whole], list(descriptors))
        self.sock.sendall(memoryview(whole)[sent:])

    def receive(self) -> tuple[Any, list[int]]:
        """Next message and the descriptors with it; EOFError if the other process has gone."""
        header, descriptors, _, _ = socket.recv_fds(self.sock, HEADER, MOST_DESCRIPTORS)
        header += self._receive_exactly(HEADER - len(header))
        packed = self._receive_exactly(int.from_bytes(header, "little"))
        return pickle.loads(packed), descriptors  # noqa: S301 - from a process of our own

    def _receive_exactly(self, size: int) -> bytes:
        parts = bytearray()
        while len(parts) < size:
            part = self.sock.recv(min(size - len(parts), 1 << 20))
            if not part:
                raise EOFError
            parts += part
        return bytes(parts)

    def close(self) -> None:
        """Close the socket; the other process then reads the end."""
        with contextlib.suppress(OSError):
            self.sock.shutdown(socket.SHUT_RDWR)
        self.sock.close()
