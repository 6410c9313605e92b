"""Requests between processes of one host, and their answers, over a `Channel`."""

import logging
import os
import socket
import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from hapticdb.errors import HapticDBError
from hapticdb.realtime.channel import Channel

LOG = logging.getLogger("hapticdb.hosting")


class Ask(NamedTuple):
    """A request: what to do, and with what."""

    word: str
    content: tuple[Any, ...] = ()


class Reply(NamedTuple):
    """The answer to a request, or the error that it raised."""

    content: Any = None
    error: Exception | None = None


class AskingChannel(Channel):
    """A channel of requests, one at a time, and their answers."""

    def __init__(self, sock: socket.socket) -> None:
        super().__init__(sock)
        self._asking = threading.Lock()

    def ask(self, word: str, *content: object, descriptors: Sequence[int] = ()) -> Any:  # noqa: ANN401
        """Send a request and return the answer of the other process; one request at a time.

        Raises
        ------
        HapticDBError
            If the other process has ended or does not answer; and every error of the other process.
        """
        with self._asking:
            try:
                self.send(Ask(word, content), descriptors)
                answer, _ = self.receive()
            except (EOFError, OSError) as error:
                self.close()  # a late answer must not be taken for that of the next request
                raise HapticDBError(
                    "the process that runs the sessions does not answer: begin them again"
                ) from error
        if answer.error is not None:
            raise answer.error
        return answer.content

    def reply(self, do: Callable[[Ask, list[int]], Any]) -> None:
        """Receive a request, do it, and send its result or the error that it raised.

        An error that is no HapticDBError is logged, and sent as one without its words. The
        descriptors that came with the request are closed afterwards.

        Raises
        ------
        EOFError, OSError
            If the other process has closed its end, or has died; never for what `do` raises.
        """
        ask, descriptors = self.receive()
        try:
            answer = Reply(do(ask, descriptors))
        except HapticDBError as error:
            answer = Reply(error=error)
        except Exception:
            LOG.exception("a request failed: %s", ask.word)
            answer = Reply(
                error=HapticDBError("the host failed at this request: its log says why; try again")
            )
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        self.send(answer)
