"""Whether a server that sends nothing hangs: it is asked once more, on a socket of its own.

A statement without a time limit may be silent for minutes because the server works on it. A server
that works also answers a new client; one that hangs, or whose network is cut, does not. The
question is PostgreSQL's SSLRequest ("SSL Session Encryption" in its manual): it needs no password
and takes none of the server's connections.
"""

import os
import socket
import struct
from typing import NamedTuple

from psycopg import pq

from hapticdb.errors import StuckError

SILENCE_S = 5.0
"""Seconds without a byte from a server, after which it is asked whether it answers at all. A larger
value asks a busy server less often, and notices later that it hangs."""
ANSWER_S = 5.0
"""Seconds that a server has to accept such a question, and again to answer it. A larger value bears
slower servers, and notices later that one hangs."""
SSL_REQUEST = struct.pack("!ii", 8, 80877103)


class SilentServerError(StuckError):
    """A server that sent nothing for longer than it may take, or that does not answer at all."""


class Peer(NamedTuple):
    """Where a connected server listens, as `socket.connect` takes it."""

    family: socket.AddressFamily
    address: str | tuple[str | int, ...]

    @classmethod
    def of(cls, pgconn: pq.abc.PGconn) -> "Peer | None":
        """The server of a connection; None if its address cannot be told."""
        try:
            with socket.socket(fileno=os.dup(pgconn.socket)) as connected:
                family = socket.AddressFamily(connected.family)
                if family != socket.AF_UNIX:
                    return cls(family, connected.getpeername())
        except OSError:
            return None
        # the server may know its socket by another path
        folder, port = pgconn.host.decode(), pgconn.port.decode()
        path = f"{folder}/.s.PGSQL.{port}"
        return cls(family, "\0" + path[1:] if path.startswith("@") else path)

    def answers(self) -> bool:
        """Whether the server answers a new client."""
        try:
            with socket.socket(self.family) as asking:
                asking.settimeout(ANSWER_S)
                asking.connect(self.address)
                asking.sendall(SSL_REQUEST)
                return bool(asking.recv(1))
        except OSError:
            return False
