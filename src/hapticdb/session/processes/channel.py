"""Channel: pickled messages between processes of our own, with file descriptors.

The processes trust one another: one of them started the others, and the sockets between them have
no name. Nothing of a client from outside goes through a channel unparsed.
"""

import contextlib
import logging
import os
import pickle
import socket
import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from hapticdb.errors import HapticDBError

LOG = logging.getLogger("hapticdb.session")
MOST_DESCRIPTORS = 16
"""Most file descriptors of one message."""
HEADER = 8
"""Bytes of a message's length."""


class Message(NamedTuple):
    """A word for the kind of a message, and its content: of "error" an exception."""

    word: str
    content: Any = None


class Channel:
    """Messages over its end of a pair of sockets of the family AF_UNIX."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self._requesting = threading.Lock()

    def send(self, content: object, descriptors: Sequence[int] = ()) -> None:
        """Send a message, and file descriptors with it."""
        packed = pickle.dumps(content)
        whole = len(packed).to_bytes(HEADER, "little") + packed
        # descriptors go with the first part of a large message; the rest follows alone
        sent = socket.send_fds(self.sock, [whole], list(descriptors))
        self.sock.sendall(memoryview(whole)[sent:])

    def receive(self) -> tuple[Any, list[int]]:
        """Next message and the descriptors with it; EOFError if the other process has gone."""
        # no more than the header: the next message may already be behind this one
        header, descriptors, _, _ = socket.recv_fds(self.sock, HEADER, MOST_DESCRIPTORS)
        header += self._receive_exactly(HEADER - len(header))
        packed = self._receive_exactly(int.from_bytes(header, "little"))
        return pickle.loads(packed), descriptors  # noqa: S301 - from a process of our own

    def call(self, word: str, *content: object, descriptors: Sequence[int] = ()) -> Any:  # noqa: ANN401
        """Send a request and return the answer of the other process; one request at a time.

        Raises the other process's error, or `HapticDBError` if it has ended or does not answer.
        """
        # answers carry no number: one request in flight pairs them
        with self._requesting:
            try:
                self.send(Message(word, content), descriptors)
                answer, _ = self.receive()
            except (EOFError, OSError) as error:
                self.close()  # a late answer must not be taken for that of the next request
                raise HapticDBError(
                    "the process that runs the sessions does not answer: begin them again"
                ) from error
        if answer.word == "error":
            raise answer.content
        return answer.content

    def reply(self, do: Callable[[Message, list[int]], Any]) -> None:
        """Receive a request, do it, and send its result or error.

        Any other error than a HapticDBError is logged, and sent as one without its words. The
        request's descriptors are closed afterwards. Raises EOFError or OSError only if the other
        process has closed its end, or has died.
        """
        request, descriptors = self.receive()
        try:
            answer = Message("done", do(request, descriptors))
        except HapticDBError as error:
            answer = Message("error", error)
        except Exception:
            LOG.exception("a request failed: %s", request.word)
            message = "the host failed at this request: its log says why; try again"
            answer = Message("error", HapticDBError(message))
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        self.send(answer)

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
