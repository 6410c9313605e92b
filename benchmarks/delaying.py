"""A TCP relay that delays what passes, in a process of its own.

    python benchmarks/delaying.py PORT SECONDS   # SECONDS are added to a round trip

It listens on 127.0.0.1, prints its port, and ends when its standard input closes.
"""

import queue
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from typing import Self

PIECES = 4096
"""Most pieces of 64 KiB on the way in one direction. Larger: more memory for a sender that is
faster than its receiver."""
READY_WITHIN = 30.0
"""Seconds in which a process must print its port, and end when it is asked to."""
IDLE_FOR = 600.0
"""Seconds without a byte in one direction after which the relay ends it."""


class DelayingRelay:
    """Relays connections to a port of this machine. Also a context manager.

    Parameters
    ----------
    port : int
        Where to relay to.
    seconds : float
        Latency added to a round trip, half of it each way.
    """

    def __init__(self, port: int, seconds: float) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(port), repr(seconds)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        late = threading.Timer(READY_WITHIN, self._process.kill)
        late.start()
        assert self._process.stdout is not None
        told = self._process.stdout.readline()
        late.cancel()
        if not told:
            self._process.wait(READY_WITHIN)
            raise RuntimeError("no relay began")
        self.port = int(told)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the process; its connections are cut."""
        with suppress(subprocess.TimeoutExpired):
            self._process.communicate(timeout=READY_WITHIN)  # closes its input
        self._process.kill()
        self._process.wait(READY_WITHIN)


# -- in the process -------------------------------------------------------------------------------


def relay(port: int, seconds: float) -> None:
    """Relay connections to a port, in threads, for as long as the process lives."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        print(listening.getsockname()[1], flush=True)
        while True:
            near, _ = listening.accept()
            try:
                far = socket.create_connection(("127.0.0.1", port), READY_WITHIN)
            except OSError:
                near.close()
                continue
            for one, other in ((near, far), (far, near)):
                one.settimeout(None)
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                pieces: queue.Queue[tuple[float, bytes]] = queue.Queue(PIECES)
                _start(_read, one, pieces, 0.5 * seconds)
                _start(_write, other, pieces)


def _start(target: object, *arguments: object) -> None:
    threading.Thread(target=target, args=arguments, daemon=True).start()  # type: ignore[arg-type]


def _read(peer: socket.socket, pieces: "queue.Queue[tuple[float, bytes]]", seconds: float) -> None:
    """Note what comes, and when it is due; nothing stands for the end."""
    data = b"-"
    while data:
        try:
            data = peer.recv(65536)
        except OSError:
            data = b""
        pieces.put((time.monotonic() + seconds, data))


def _write(peer: socket.socket, pieces: "queue.Queue[tuple[float, bytes]]") -> None:
    """Send each piece when it is due."""
    while True:
        try:
            due, data = pieces.get(timeout=IDLE_FOR)
        except queue.Empty:
            due, data = time.monotonic(), b""
        time.sleep(max(due - time.monotonic(), 0.0))
        with suppress(OSError):
            if data:
                peer.sendall(data)
            else:
                peer.shutdown(socket.SHUT_RDWR)
        if not data:
            return


if __name__ == "__main__":
    _start(relay, int(sys.argv[1]), float(sys.argv[2]))
    sys.stdin.read()
