"""A database far away: `hapticdb feel` on PostgreSQL behind a delay of the network.

    python benchmarks/far_away.py              # the vintage car, or the sample car: two minutes
    python benchmarks/far_away.py --quick      # short sessions, into results-quick/

A relay on the loopback interface holds back whatever passes between `feel` and the server for half
of a round trip each way. A spanner slides over the model, and the cells are new wherever it comes.
"""

import contextlib
import queue
import socket
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import hapticdb
import page_tables
import records
from hapticdb import GridOptions, ImportOptions
from hapticdb.sample import write_sample
from hapticdb.store.postgres.address import with_environment
from in_real_time import CAR, EXTENT, FRAMES, SETTINGS, session
from places import PORT, USER, Server, find_binaries, serving
from slide_paths import write_along

ROUND_TRIPS = (0.0, 5e-3, 50e-3)
"""Seconds that the relay adds to a round trip."""
SPEEDS = (0.2, 1.0)
"""Speeds of the hand, m/s."""
RATE = 1000
"""Frames a second."""
NAME = "far_away"
"""The environment in the server's database."""


class Relay:
    """A port of the loopback interface, at which a server answers `seconds` a round trip later."""

    def __init__(self, server: Server, seconds: float) -> None:
        self._delay, self._target = 0.5 * seconds, str(server.folder / f".s.PGSQL.{PORT}")
        self._listener = socket.create_server(("127.0.0.1", 0))
        port = self._listener.getsockname()[1]
        self.url = with_environment(f"postgresql://{USER}@127.0.0.1:{port}/postgres", NAME)
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Take no more connections; those that there are end with their clients."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                server = socket.socket(socket.AF_UNIX)
                server.connect(self._target)
                for source, target in ((client, server), (server, client)):
                    blocks = queue.SimpleQueue[tuple[float, bytes]]()
                    for work, end in ((self._take, source), (self._give, target)):
                        threading.Thread(target=work, args=(end, blocks), daemon=True).start()

    def _take(
        self, source: socket.socket, blocks: "queue.SimpleQueue[tuple[float, bytes]]"
    ) -> None:
        block = b"-"
        while block:
            try:
                block = source.recv(1 << 16)
            except OSError:
                block = b""
            blocks.put((time.monotonic() + self._delay, block))

    @staticmethod
    def _give(target: socket.socket, blocks: "queue.SimpleQueue[tuple[float, bytes]]") -> None:
        with contextlib.suppress(OSError):
            for due, block in iter(blocks.get, None):  # `_take` ends with an empty block
                time.sleep(max(due - time.monotonic(), 0.0))
                if not block:
                    break
                target.sendall(block)
        with contextlib.suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)


def measure(folder: Path, model: Path | None, bits: int, seconds: float) -> dict[str, Any]:
    """One session a speed and round trip."""
    sample = write_sample(folder)
    options = ImportOptions(grid=GridOptions(bits=bits, extent=EXTENT))
    cells = []
    with serving(folder / "server", find_binaries()[0], SETTINGS) as server:
        url = with_environment(server.conninfo(), NAME)
        hapticdb.import_files(url, [model or sample.car], options)
        tool, path = sample.spanner, sample.path
        if model is not None:
            tool, path = write_along(folder / "along", url, FRAMES)
        for speed in SPEEDS:
            for round_trip in ROUND_TRIPS:
                with contextlib.closing(Relay(server, round_trip)) as relay:
                    words = "--speed", str(speed), "--no-baseline"
                    found = session(relay.url, tool, path, RATE, seconds, *words)
                kept = {name: found[name] for name in ("loop", "unknown_frames", "cache")}
                cells.append({"speed": speed, "round_trip": round_trip} | kept)
    inputs = {"model": (model or Path(sample.car)).name, "bits": bits, "rate": RATE}
    return records.result("far away", cells, inputs)


def main() -> None:
    """Measure, and fill the table of docs/realtime.md."""
    is_quick, out = records.asked(__doc__, "short sessions, a coarse sample")
    model = None if is_quick else records.data(CAR)
    with tempfile.TemporaryDirectory(prefix="hapticdb-far-") as folder:
        found = measure(Path(folder), model, *((8, 2.0) if is_quick else (11, 10.0)))
    records.write(out, {"far_away": found})
    if not is_quick:
        page_tables.refill("docs/realtime.md", out)


if __name__ == "__main__":
    main()
