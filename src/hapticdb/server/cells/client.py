"""One client of the endpoint for cells, from its first message to its last."""

import asyncio
import contextlib
import logging
from contextlib import ExitStack

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from hapticdb.errors import DamagedError, HapticDBError, ProtocolError
from hapticdb.protocol import cells as bodies
from hapticdb.protocol.cells import MOST_REQUEST
from hapticdb.protocol.fields import FieldsRead, FieldsWritten
from hapticdb.protocol.header import (
    NO_REVISION,
    VERSION,
    CloseCode,
    Kind,
    MessageHeader,
    Refusal,
    header_of,
)
from hapticdb.server.cells.answers import Answers, CellsAnswer, RequestRefusedError
from hapticdb.server.cells.limits import BEAT_S, NEWS_IN_FLIGHT, CellsLimits
from hapticdb.server.cells.news import news_since
from hapticdb.server.cells.readers import Readers, is_away
from hapticdb.server.cells.recent import RecentCells
from hapticdb.server.cells.watcher import Watcher
from hapticdb.server.limits import TokenBucket
from hapticdb.store.base import CELL_SHIFT, Store, row_shift
from hapticdb.store.messages import welcome_body

LONGEST_REASON = 120
"""Most bytes of a close frame's reason; the protocol has room for 123."""
LEFT = 1006
"""WebSocket's code for a peer that has left without a word."""
LOG = logging.getLogger(__name__)


class ClosingError(Exception):
    """Ends a connection with a code and a reason."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


class HeldSnapshot:
    """A store whose snapshot one client holds, for a limited time."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.opened = ExitStack()


class CellsClient:
    """One connection: answers requests one after another, and pushes news and beats.

    Parameters
    ----------
    socket : WebSocket
        Accepted.
    readers, watcher, answers : as the endpoint has them
        Shared by all clients.
    limits : CellsLimits
        What this client may ask for.
    """

    def __init__(
        self,
        socket: WebSocket,
        readers: Readers,
        watcher: Watcher,
        answers: Answers,
        limits: CellsLimits,
    ) -> None:
        self._socket = socket
        self._readers = readers
        self._watcher = watcher
        self._answers = answers
        self._limits = limits
        self._bytes = TokenBucket(limits.bytes_a_second, limits.burst_bytes)
        self._requests = TokenBucket(limits.requests_a_second, limits.burst_requests)
        self._sending = asyncio.Lock()
        self._telling = asyncio.Lock()
        self._woken = asyncio.Event()
        self._notified = NO_REVISION
        self._is_watching = False
        self._in_flight: list[int] = []
        self._recent: RecentCells | None = None
        self._snapshot: HeldSnapshot | None = None
        self._using = asyncio.Lock()
        self._is_in_snapshot = False
        self._refusal: tuple[Refusal, str] | None = None
        self._expiry: asyncio.TimerHandle | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._closing: ClosingError | None = None

    def wake(self) -> None:
        """Look now whether there is something to tell."""
        self._woken.set()

    def send_away(self, code: int, reason: str) -> None:
        """End the connection soon, with a code and a reason."""
        self._closing = ClosingError(code, reason)
        self._woken.set()

    async def serve(self) -> None:
        """Serve the client until it leaves or is sent away."""
        pusher = asyncio.create_task(self._push())
        try:
            await self._serve_all(pusher)
        except ClosingError as closing:
            await self._close(closing.code, closing.reason)
        except ProtocolError as error:
            await self._close(CloseCode.MALFORMED, str(error))
        except (WebSocketDisconnect, TimeoutError, OSError):
            pass  # it left, or does not read
        except Exception:
            LOG.exception("a client of cells was sent away after an error")
            await self._close(CloseCode.FAILED, "an error inside the server")
        finally:
            pusher.cancel()
            if self._expiry is not None:
                self._expiry.cancel()
            await asyncio.gather(pusher, *self._tasks, return_exceptions=True)
            await self._end_snapshot()

    async def _serve_all(self, pusher: "asyncio.Task[None]") -> None:
        await self._greet()
        while True:
            receiving = asyncio.ensure_future(self._received(self._limits.idle_s))
            await asyncio.wait({receiving, pusher}, return_when=asyncio.FIRST_COMPLETED)
            if pusher.done():
                receiving.cancel()
                with contextlib.suppress(BaseException):
                    await receiving
                pusher.result()  # raises why it ended
            await self._handle(receiving.result())

    async def _close(self, code: int, reason: str) -> None:
        plain = reason.encode("utf-8", "replace")[:LONGEST_REASON].decode("utf-8", "ignore")
        with contextlib.suppress(RuntimeError, OSError, TimeoutError, WebSocketDisconnect):
            async with asyncio.timeout(self._limits.sending_s):
                await self._socket.close(code, plain)

    # -- messages ----------------------------------------------------------------------------

    async def _received(self, seconds: float) -> bytes:
        """Next message. Raises ClosingError when none comes in that time, or it is no message."""
        try:
            event = await asyncio.wait_for(self._socket.receive(), seconds)
        except TimeoutError:
            raise ClosingError(CloseCode.IDLE, f"nothing came for {seconds:g} s") from None
        if event["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(event.get("code", 1000))
        message: bytes | None = event.get("bytes")
        if message is None:
            raise ClosingError(CloseCode.MALFORMED, "a text message: all messages are binary")
        if len(message) > MOST_REQUEST:
            raise ClosingError(
                CloseCode.MALFORMED, f"a message of {len(message)} bytes is too large"
            )
        if len(message) > 2 and message[:2] == b"hd" and message[2] != VERSION:
            raise ClosingError(
                CloseCode.VERSION, f"version {message[2]}: this server speaks {VERSION}"
            )
        return message

    async def _send(
        self, kind: Kind, body: bytes = b"", *, number: int = 0, revision: int = NO_REVISION
    ) -> None:
        message = MessageHeader(kind, number, revision).packed() + body
        async with self._sending, asyncio.timeout(self._limits.sending_s):
            # after a push that failed, starlette raises an error of a program at fault
            if self._socket.application_state is WebSocketState.DISCONNECTED:
                raise WebSocketDisconnect(LEFT)
            await self._socket.send_bytes(message)

    async def _pay(self, bucket: TokenBucket, amount: float) -> None:
        """Wait until the client may have that amount; it reads nothing meanwhile."""
        amount = min(amount, bucket.burst)
        await asyncio.sleep(bucket.wait(amount))
        bucket.take(amount)

    async def _greet(self) -> None:
        """CellsAnswer the first message."""
        message = await self._received(self._limits.greeting_s)
        header = header_of(message)
        FieldsRead(message).end()
        if header.kind != Kind.HELLO:
            raise ClosingError(CloseCode.MALFORMED, "the first message is no HELLO")
        try:
            async with self._readers.lent(anew=True) as store:
                welcome = welcome_body(store, BEAT_S)
                self._recent = RecentCells(CELL_SHIFT - row_shift(store.layout))
        except (HapticDBError, OSError) as error:
            refusal, text = _refusal_of(error)
            body = FieldsWritten().u2(refusal).text(text).joined()
            await self._send(Kind.REFUSED, body, number=header.number)
            raise ClosingError(CloseCode.ENDS, text) from error
        await self._send(Kind.WELCOME, welcome.packed(), number=header.number)

    async def _handle(self, message: bytes) -> None:
        """Do what one message asks for."""
        header = header_of(message)
        body = FieldsRead(message)
        await self._pay(self._requests, 1.0)
        if header.kind == Kind.BEGIN:
            (wanted,) = bodies.numbers_of(body, 1)
            await self._begin_snapshot(wanted)
        elif header.kind == Kind.END:
            body.end()
            self._is_in_snapshot = False
            await self._end_snapshot()
        elif header.kind == Kind.NOTED:
            body.end()
            self._in_flight = [one for one in self._in_flight if one > header.revision]
            self._woken.set()
        else:
            await self._answer(header, body)

    async def _answer(self, header: MessageHeader, body: FieldsRead) -> None:
        try:
            answer = await self._found(header.kind, body)
        except ProtocolError:
            raise
        except (HapticDBError, OSError) as error:
            code, text = _refusal_of(error)
            refused = FieldsWritten().u2(code).text(text).joined()
            await self._send(Kind.REFUSED, refused, number=header.number)
            return
        if header.kind == Kind.WATCH:
            self._is_watching, self._notified = True, answer.revision
            self._in_flight = []
        if answer.asked is not None and self._recent is not None:
            self._recent.note(answer.asked)
        if answer.revision > self._notified:
            await self._tell_news()  # first, so that the client can follow without a question
        await self._pay(self._bytes, len(answer.body))
        await self._send(answer.kind, answer.body, number=header.number, revision=answer.revision)

    async def _found(self, kind: int, body: FieldsRead) -> CellsAnswer:
        """CellsAnswer of a store: that of the snapshot, or any."""

        def ask(store: Store) -> CellsAnswer:
            return self._answers.answer(store, kind, body)

        if not self._is_in_snapshot:
            async with self._readers.lent() as store:
                return await self._readers.run(store, ask)
        async with self._using:
            if self._refusal is not None:
                raise RequestRefusedError(*self._refusal)
            if self._snapshot is None:
                raise RequestRefusedError(
                    Refusal.OUTDATED, "the snapshot took too long and was ended"
                )
            return await self._readers.run(self._snapshot.store, ask)

    # -- snapshots ---------------------------------------------------------------------------

    async def _begin_snapshot(self, wanted: int) -> None:
        """Hold a snapshot for the requests that follow, if it is of the wanted revision."""
        if self._is_in_snapshot:
            raise ClosingError(CloseCode.MALFORMED, "a snapshot inside a snapshot")
        self._is_in_snapshot, self._refusal = True, None
        store = await self._hold()
        if store is None:
            return
        held = self._snapshot = HeldSnapshot(store)

        def begin(store: Store) -> int:
            held.opened.enter_context(store.snapshot())
            return store.revision()

        try:
            revision = await self._readers.run(store, begin)
        except (HapticDBError, OSError) as error:
            self._refusal = _refusal_of(error)
            await self._end_snapshot(is_sound=False)
            return
        if wanted not in {NO_REVISION, revision}:
            self._refusal = (Refusal.OUTDATED, "another has written meanwhile: read again")
            await self._end_snapshot()
            return
        loop = asyncio.get_running_loop()
        self._expiry = loop.call_later(self._limits.snapshot_s, self._expire)

    async def _hold(self) -> Store | None:
        """Take a store for a snapshot; None, and a refusal for what follows, if there is none."""
        try:
            store = await self._readers.hold(self._limits.waiting_s)
        except (HapticDBError, OSError) as error:
            self._refusal = _refusal_of(error)
            return None
        if store is None:
            self._refusal = (Refusal.BUSY, "too many snapshots are held now")
        return store

    def _expire(self) -> None:
        task = asyncio.get_running_loop().create_task(self._end_snapshot())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _end_snapshot(self, *, is_sound: bool = True) -> None:
        """End the snapshot, if one is held, and give its store back."""
        if self._expiry is not None:
            self._expiry.cancel()
            self._expiry = None
        async with self._using:
            held, self._snapshot = self._snapshot, None
            if held is None:
                return
            try:
                await self._readers.run(held.store, lambda _: held.opened.close())
            except (HapticDBError, OSError):
                is_sound = False
            finally:
                await self._readers.give_back(held.store, is_sound=is_sound)

    # -- pushes ------------------------------------------------------------------------------

    async def _push(self) -> None:
        """Tell of new revisions at once, and otherwise that the database answers."""
        while True:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._woken.wait(), BEAT_S)
            self._woken.clear()
            if self._closing is not None:
                raise self._closing
            if not self._is_watching:
                continue
            if self._watcher.revision not in {NO_REVISION, self._notified}:
                with contextlib.suppress(HapticDBError, OSError):
                    await self._tell_news()
            if self._watcher.is_confirmed:
                await self._send(Kind.BEAT, revision=self._watcher.revision)

    async def _tell_news(self) -> None:
        """Tell what was written since the last NEWS, unless the client has many unread ones."""
        if not self._is_watching:
            return
        async with self._telling:
            recent, since = self._recent, self._notified
            if len(self._in_flight) >= NEWS_IN_FLIGHT or recent is None:
                return
            async with self._readers.lent() as store:
                read = recent.copy()  # in a thread, while further scans are noted here
                revision, news = await self._readers.run(
                    store, lambda one: news_since(one, since, read)
                )
            if revision == self._notified:
                return
            self._notified = revision
            self._in_flight.append(revision)
            body = news.packed()
            await self._pay(self._bytes, len(body))
            await self._send(Kind.NEWS, body, revision=revision)


def _refusal_of(error: BaseException) -> tuple[Refusal, str]:
    """Code and text of a refusal: in words of its own, since errors name files and addresses."""
    if isinstance(error, RequestRefusedError):
        return error.code, str(error)
    if is_away(error):
        return Refusal.AWAY, "the database does not answer"
    LOG.warning("a client of cells was refused: %s", error)
    if isinstance(error, DamagedError):
        return Refusal.DAMAGED, "the environment is damaged: 'hapticdb check' there names the place"
    return Refusal.FAILED, "the server could not read its environment"
