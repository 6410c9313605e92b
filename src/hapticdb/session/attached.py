"""AttachedHost: a host's sessions from another process, over a pair of sockets."""

import logging
import socket
from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from hapticdb.closing import Closes
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.pointshell.shell import PointShell
from hapticdb.session.coupling import Coupling
from hapticdb.session.hosted import Calls, HostedSession
from hapticdb.session.processes.channel import Channel, Message
from hapticdb.session.shared_table import SharedTable
from hapticdb.store.finding import Words

LOG = logging.getLogger("hapticdb.session")


class AttachedHost(Closes):
    """The `SessionHost` of another process, by `SessionHost.serve` at the other end of `sock`.

    Frames, contacts and hands are in shared memory; all else goes over the socket, one request at a
    time. The sessions of this process end when it dies or closes. Also a context manager. Raises
    `HapticDBError` if the other process does not answer.
    """

    def __init__(self, sock: socket.socket) -> None:
        sock.settimeout(None)
        self._channel = Channel(sock)
        try:
            _, (descriptor,) = self._channel.receive()
        except (EOFError, OSError, ValueError) as error:
            self._channel.close()
            raise HapticDBError("no host answers at the other end of the socket") from error
        self._shared = SharedTable(descriptor)
        self._is_closed = False

    def begin(
        self,
        shell: PointShell,
        start: ArrayLike,
        *,
        where: Words = (),
        exclude: Words = (),
        coupling: Coupling | None = None,
        scale: float = 1.0,
    ) -> HostedSession:
        """Begin a session; as `SessionHost.begin`, with its errors."""
        options = {"where": where, "exclude": exclude, "coupling": coupling, "scale": scale}
        if self._is_closed:
            raise UsageError("the host was left: attach to it again")
        slot, session = self._channel.call("begin", shell, start, options)
        return HostedSession(self._shared, slot, session, self._call)

    def _call(self, word: str, session: int, /, *content: object) -> object:
        if self._is_closed:
            if word == "end":
                return None
            raise UsageError("the host was left: attach to it again")
        return self._channel.call("call", word, session, *content)

    def close(self) -> None:
        """Leave the host; the sessions of this process end."""
        self._is_closed = True
        self._channel.close()
        self._shared.close()


def serve_attached(
    sock: socket.socket, shared: SharedTable, begin: Callable[..., HostedSession], call: Calls
) -> None:
    """Serve an `AttachedHost` until it leaves, by a host's methods; then end its sessions."""
    channel = Channel(sock)
    begun: set[int] = set()

    def do(message: Message, _: list[int]) -> Any:  # noqa: ANN401 - the answer to any request
        if message.word == "begin":
            shell, start, options = message.content
            session = begin(shell, start, **options)
            begun.add(session.id)
            return session.slot, session.id
        word, number, *content = message.content
        return call(word, number, *content)

    try:
        # first the descriptor of the shared memory, to which the other process maps its slots
        channel.send(None, [shared.descriptor])
        while True:
            channel.reply(do)
    except (EOFError, OSError):
        pass
    finally:
        channel.close()
        for number in begun:
            # one session that fails to end keeps none of the others
            try:
                call("end", number)
            except Exception:
                LOG.exception("session %d of a process that left did not end well", number)
