"""AttachedHost: a host's sessions from another process, over a pair of sockets."""

import logging
import socket
from collections.abc import Callable
from typing import Any, Self

from numpy.typing import ArrayLike

from hapticdb.errors import HapticDBError
from hapticdb.hosting.board import Board
from hapticdb.hosting.channel import Ask, Channel
from hapticdb.hosting.hosted import Calls, HostedSession
from hapticdb.hosting.tables import Words
from hapticdb.pointshell.shell import PointShell
from hapticdb.realtime.coupling import Coupling

LOG = logging.getLogger("hapticdb.hosting")


class AttachedHost:
    """The `SessionHost` of another process. It has the same methods for sessions.

    Frames, contacts and hands are in memory that both processes share; all else goes over the
    socket, one request at a time. The sessions that this process has begun end when it dies or
    closes. Also a context manager.

    Parameters
    ----------
    sock : socket
        End of a pair of sockets of the family AF_UNIX; the other end was given to
        `SessionHost.serve`. It is owned from now on.

    Raises
    ------
    HapticDBError
        If the other process does not answer.
    """

    def __init__(self, sock: socket.socket) -> None:
        sock.settimeout(None)
        self._channel = Channel(sock)
        try:
            (self.url, self.rate), (descriptor,) = self._channel.receive()
        except (EOFError, OSError, ValueError) as error:
            self._channel.close()
            raise HapticDBError("no host answers at the other end of the socket") from error
        self._board = Board(descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def begin(
        self,
        shell: PointShell,
        start: ArrayLike,
        *,
        where: Words = (),
        exclude: Words = (),
        coupling: Coupling | None = None,
        scale: float = 1.0,
        label: str = "",
        budget_points: int | None = None,
    ) -> HostedSession:
        """Begin a session; as `SessionHost.begin`, with its errors."""
        options = {
            "where": where, "exclude": exclude, "coupling": coupling, "scale": scale,
            "label": label, "budget_points": budget_points,
        }  # fmt: skip
        seat, session = self._channel.ask("begin", shell, start, options)
        return HostedSession(self._board, seat, session, self._call)

    def sessions(self) -> list[HostedSession]:
        """All sessions of the host that run now, by their ids; also those of other processes."""
        return [
            HostedSession(self._board, seat, session, self._call)
            for seat, session in self._channel.ask("sessions")
        ]

    def _call(self, word: str, session: int, /, *content: object) -> object:
        return self._channel.ask("call", word, session, *content)

    def close(self) -> None:
        """Leave the host; the sessions that this process has begun end."""
        self._channel.close()
        self._board.close()


class Attachment:
    """The host's side of an `AttachedHost`.

    Parameters
    ----------
    channel : Channel
        To the other process.
    begin, call, sessions : callable
        The host's.
    """

    def __init__(
        self,
        channel: Channel,
        begin: Callable[..., HostedSession],
        call: Calls,
        sessions: Callable[[], list[HostedSession]],
    ) -> None:
        self._channel, self._begin, self._call, self._sessions = channel, begin, call, sessions
        self._begun: set[int] = set()

    def serve(self) -> None:
        """Reply requests until the other process leaves; then end its sessions."""
        try:
            while True:
                self._channel.reply(self._do)
        except (EOFError, OSError):
            pass
        finally:
            self._channel.close()
            for session in self._begun:
                try:
                    self._call("end", session)
                except Exception:
                    LOG.exception("session %d of a process that left did not end well", session)

    def _do(self, ask: Ask, _: list[int]) -> Any:  # noqa: ANN401 - the answer to any request
        if ask.word == "begin":
            shell, start, options = ask.content
            session = self._begin(shell, start, **options)
            self._begun.add(session.id)
            return session.seat, session.id
        if ask.word == "sessions":
            return [(one.seat, one.id) for one in self._sessions()]
        word, session, *content = ask.content
        return self._call(word, session, *content)


def serve_attached(
    sock: socket.socket,
    place: tuple[str, float, Board],
    begin: Callable[..., HostedSession],
    call: Calls,
    sessions: Callable[[], list[HostedSession]],
) -> None:
    """Serve an `AttachedHost` until it leaves; place: the host's URL, rate and board."""
    url, rate, board = place
    channel = Channel(sock)
    try:
        channel.send((url, rate), [board.descriptor])
    except OSError:
        channel.close()
        return
    Attachment(channel, begin, call, sessions).serve()
