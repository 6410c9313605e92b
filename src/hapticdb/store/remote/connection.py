"""A connection to a server: requests and answers, pushes, and the way back after a loss."""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection

from hapticdb.errors import (
    BusyError,
    ConnectionLostError,
    DamagedError,
    DatabaseError,
    HapticDBError,
    OutdatedError,
    ProtocolError,
    StuckError,
    UsageError,
)
from hapticdb.protocol.cells import MOST_ANSWER, WelcomeBody, welcome_of
from hapticdb.protocol.fields import FieldsRead
from hapticdb.protocol.header import NO_REVISION, Kind, MessageHeader, Refusal, header_of
from hapticdb.protocol.opening import open_websocket
from hapticdb.store.refusals import check_outside
from hapticdb.store.threads import check_thread, this_thread
from hapticdb.store.urls import RemoteAddress

Answer = TypeVar("Answer")
Message = tuple[MessageHeader, FieldsRead]

OPEN_SECONDS = 10.0
"""Longest time for a connection to be made. Larger: a slow network is waited for longer."""
ANSWER_SECONDS = 15.0
"""Longest time for an answer. Larger: a server that hangs is noticed later; smaller: a large answer
over a slow network is given up."""
CLOSE_SECONDS = 0.5
"""Longest time for the closing handshake. Larger: a vanished server delays the end."""
RECONNECT_SECONDS = 5.0
"""Seconds of tries to reach a lost server. Larger: a slower restart is survived, but a read waits
longer for its error."""
FIRST_PAUSE_SECONDS = 0.05
"""Pause between the first two tries to connect again; each next pause is twice as long."""
MOST_PAUSE_SECONDS = 0.5
"""Longest pause between two tries. Larger: a struggling server is asked less often."""
FRAMES_HELD = 64
"""Pushes and answers that may wait to be read. Larger: more memory while the client is busy."""
CAUSES: dict[Refusal, tuple[type[HapticDBError], str]] = {
    Refusal.USAGE: (UsageError, ""),
    Refusal.NO_OBJECT: (DatabaseError, ""),
    Refusal.AWAY: (ConnectionLostError, "the server cannot reach its database now: "),
    Refusal.DAMAGED: (DamagedError, ""),
    Refusal.TOO_MUCH: (DatabaseError, ""),
    Refusal.OUTDATED: (OutdatedError, ""),
    Refusal.BUSY: (BusyError, ""),
    Refusal.FAILED: (DatabaseError, ""),
}


class RemoteConnection:
    """One connection to a server's endpoint for cells; belongs to the thread that opened it.

    Parameters
    ----------
    address : RemoteAddress
        Where the server is.
    hear : callable
        Called with each push: a header and its body.

    Attributes
    ----------
    welcome : WelcomeBody
        What the server tells about its environment.
    heard_at, sent_at : float
        Times of the last message that came and of the last one that went, as of `time.monotonic`.
    """

    def __init__(
        self, address: RemoteAddress, hear: Callable[[MessageHeader, FieldsRead], None]
    ) -> None:
        self.address = address
        self.shown = address.shown
        self.is_closed = False
        self.heard_at = self.sent_at = 0.0
        self.n_connected = 0
        self._hear = hear
        self._thread = this_thread()
        self._depth = 0
        self._number = 0
        self._link: ClientConnection | None = None
        self.welcome = self._connect()

    # -- the connection ----------------------------------------------------------------------

    def _connect(self) -> WelcomeBody:
        """Connect once, and greet."""
        self._link = open_websocket(
            self.address.endpoint,
            token=self.address.token,
            trust=self.address.trust(),
            shown=self.shown,
            open_timeout=OPEN_SECONDS,
            close_timeout=CLOSE_SECONDS,
            ping_interval=None,  # beats come anyway, and every request has a time limit
            max_size=MOST_ANSWER,
            max_queue=FRAMES_HELD,
        )
        self.n_connected += 1
        header, body = self._exchange(Kind.HELLO, b"")
        if header.kind != Kind.WELCOME:
            self._drop()
            raise self._refusal(header, body)
        try:
            return welcome_of(body)
        except ProtocolError:
            self._drop()
            raise

    def close(self) -> None:
        """Close the connection."""
        self.is_closed = True
        self._drop()

    def _drop(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            with contextlib.suppress(OSError, WebSocketException):
                link.close()

    def _reconnect(self) -> None:
        """Connect again and again, for up to `RECONNECT_SECONDS`; then raise the last error."""
        self._drop()
        deadline = time.monotonic() + RECONNECT_SECONDS
        pause = FIRST_PAUSE_SECONDS
        while True:
            try:
                welcome = self._connect()
                break
            except (ConnectionLostError, BusyError):
                if time.monotonic() + pause > deadline:
                    raise
                time.sleep(pause)
                pause = min(2 * pause, MOST_PAUSE_SECONDS)
        if welcome.identity != self.welcome.identity:
            self._drop()
            raise ConnectionLostError(
                f"{self.shown} is another environment than before: open it again"
            )
        self.welcome = welcome

    def give_to(self, thread: int) -> None:
        """Give the connection to another thread, or to `NOBODY`. No call may be under way."""
        self._thread = thread

    def check_thread(self) -> None:
        """Refuse a call from any thread but the connection's owner, or on a closed connection."""
        check_thread(self._thread, self.shown)
        if self.is_closed:
            raise DatabaseError(f"{self.shown} has been closed: open it again")

    # -- messages ----------------------------------------------------------------------------

    def ask(self, kind: Kind, body: bytes = b"", *, answer: Kind) -> Message:
        """Send a request; returns its answer's header and body.

        When the connection is lost, connect again and ask once more; not inside a snapshot.

        Raises
        ------
        OutdatedError
            When the server does not hold the snapshot any more.
        """
        self.check_thread()
        header, found = self._again(lambda: self._exchange(kind, body))
        if header.kind != answer:
            raise self._refusal(header, found)
        return header, found

    def tell(self, kind: Kind, body: bytes = b"", *, revision: int = NO_REVISION) -> None:
        """Send a message that has no answer."""
        header = MessageHeader(kind, revision=revision)
        with self._lost_as_error():
            self._send(header.packed() + body)

    def hear(self) -> bool:
        """Take in all pushes that have arrived; never waits. Connects again after a loss.

        Returns whether the connection is the same as before.
        """
        self.check_thread()
        before = self.n_connected
        if self._link is None:
            self._reconnect()
        try:
            with self._lost_as_error():
                while (message := self._received(0.0)) is not None:
                    self._take_push(message)
        except ConnectionLostError:
            self._reconnect()
        return self.n_connected == before

    def _again(self, exchange: Callable[[], Message]) -> Message:
        try:
            if self._link is None and not self._depth:
                self._reconnect()
            return exchange()
        except ConnectionLostError:
            if self._depth:
                raise
        self._reconnect()
        return exchange()

    def _exchange(self, kind: Kind, body: bytes) -> Message:
        """Send a request and wait for its answer; pushes that come before it are taken in."""
        self._number = self._number % 0xFFFFFFFF + 1
        deadline = time.monotonic() + ANSWER_SECONDS
        with self._lost_as_error():
            self._send(MessageHeader(kind, self._number).packed() + body)
            while True:
                message = self._received(deadline - time.monotonic())
                if message is None:
                    self._drop()
                    raise StuckError(
                        f"{self.shown} did not answer within {ANSWER_SECONDS:g} s: try again"
                    )
                header = header_of(message)
                if header.number == self._number:
                    return header, FieldsRead(message)
                self._take_push(message)

    def _send(self, message: bytes) -> None:
        if self._link is None:
            raise ConnectionLostError(f"{self.shown}: the connection was lost")
        self._link.send(message)
        self.sent_at = time.monotonic()

    def _received(self, seconds: float) -> bytes | None:
        """Next message; None if none comes in that time."""
        if self._link is None:
            raise ConnectionLostError(f"{self.shown}: the connection was lost")
        try:
            message = self._link.recv(max(seconds, 0.0), decode=False)
        except TimeoutError:
            return None
        self.heard_at = time.monotonic()
        return bytes(message)

    def _take_push(self, message: bytes) -> None:
        """Pass a push on; an answer that nobody waits for breaks the protocol."""
        header = header_of(message)
        if header.number:
            raise ProtocolError(f"{self.shown}: the server answered what was not asked")
        self._hear(header, FieldsRead(message))

    @contextlib.contextmanager
    def _lost_as_error(self) -> Iterator[None]:
        """Turn the loss of the connection into an error of hapticdb; drops a broken connection."""
        try:
            yield
        except (OSError, WebSocketException, ProtocolError) as error:
            if isinstance(error, HapticDBError) and not isinstance(error, ProtocolError):
                raise
            self._drop()
            if isinstance(error, ProtocolError):
                raise
            cause = " ".join(str(error).split()) or type(error).__name__
            raise ConnectionLostError(
                f"{self.shown}: the connection was lost ({cause}); run the same again when the "
                "server is back"
            ) from error

    def _refusal(self, header: MessageHeader, body: FieldsRead) -> HapticDBError:
        """Error for an answer that is not the one asked for."""
        if header.kind != Kind.REFUSED:
            return ProtocolError(f"{self.shown}: the server answered by a message {header.kind}")
        code, text = body.u2(), body.text()
        if code not in set(Refusal):
            return DatabaseError(f"{self.shown}: {text}")
        error, before = CAUSES[Refusal(code)]
        return error(f"{self.shown}: {before}{text}")

    # -- snapshots ---------------------------------------------------------------------------

    @property
    def is_in_snapshot(self) -> bool:
        """Whether a snapshot has been entered and not left."""
        return self._depth > 0

    def enter(self) -> bool:
        """Enter a snapshot; returns whether it is the outermost."""
        self.check_thread()
        self._depth += 1
        return self._depth == 1

    def leave(self) -> bool:
        """Leave a snapshot; returns whether it was the outermost."""
        self._depth -= 1
        return self._depth == 0

    def check_outside(self) -> None:
        """Refuse to look for the commits of others inside a snapshot."""
        self.check_thread()
        check_outside(self._depth, self.shown)
