"""A TCP relay that delays what passes, in a process of its own, and round trips of a bare echo.

    python benchmarks/delaying.py relay PORT SECONDS   # SECONDS are added to a round trip
    python benchmarks/delaying.py echo                 # a WebSocket that sends back what it gets

Both listen on 127.0.0.1, print their port, and end when their standard input closes.
"""

import queue
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from typing import Self

import numpy as np
from numpy.typing import NDArray

PIECES = 4096
"""Most pieces of 64 KiB on the way in one direction. Larger: more memory for a sender that is
faster than its receiver."""
READY_WITHIN = 30.0
"""Seconds in which a process must print its port, and end when it is asked to."""
IDLE_FOR = 600.0
"""Seconds without a byte in one direction after which the relay ends it."""
ECHO_BYTES = 100
"""Bytes of a message of the echo: those of a hand."""


class ChildServer:
    """A server of this module in a process of its own. Also a context manager.

    Parameters
    ----------
    arguments : str
        What the process is started with.
    """

    def __init__(self, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        late = threading.Timer(READY_WITHIN, self._process.kill)
        late.start()
        assert self._process.stdout is not None
        told = self._process.stdout.readline()
        late.cancel()
        if not told:
            self._process.wait(READY_WITHIN)
            raise RuntimeError(f"no server began: {arguments}")
        self.port = int(told)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the process; its connections are cut."""
        with suppress(subprocess.TimeoutExpired):
            self._process.communicate(timeout=READY_WITHIN)  # closes its input
        self._process.kill()
        self._process.wait(READY_WITHIN)


class DelayingRelay(ChildServer):
    """Relays connections to a port of this machine. Half of the latency is added each way.

    Parameters
    ----------
    port : int
        Where to relay to.
    seconds : float
        Latency added to a round trip.
    """

    def __init__(self, port: int, seconds: float) -> None:
        super().__init__("relay", str(port), repr(seconds))


def echo_trips(seconds: float, count: int) -> NDArray[np.float64]:
    """Round trips (count,), s, of a bare WebSocket echo with seconds of added latency."""
    from websockets.sync.client import connect  # noqa: PLC0415 - an extra

    trips = np.zeros(count)
    with ChildServer("echo") as echo, DelayingRelay(echo.port, seconds) as relay:
        url = f"ws://127.0.0.1:{relay.port}"
        with connect(url, compression=None, proxy=None, open_timeout=READY_WITHIN) as peer:
            for n in range(-10, count):  # the first ones warm both sides up
                start = time.perf_counter()
                peer.send(bytes(ECHO_BYTES))
                peer.recv(READY_WITHIN)
                trips[max(n, 0)] = time.perf_counter() - start
    return trips


# -- in the processes ------------------------------------------------------------------------------


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


def echo() -> None:
    """Send back what comes, for as long as the process lives."""
    from websockets.sync.server import ServerConnection, serve  # noqa: PLC0415 - an extra

    def send_back(connection: ServerConnection) -> None:
        for message in connection:
            connection.send(message)

    with serve(send_back, "127.0.0.1", 0, compression=None) as server:
        print(server.socket.getsockname()[1], flush=True)
        server.serve_forever()


def main() -> None:
    """Serve until standard input closes."""
    if sys.argv[1] == "relay":
        _start(relay, int(sys.argv[2]), float(sys.argv[3]))
    else:
        _start(echo)
    sys.stdin.read()


if __name__ == "__main__":
    main()
