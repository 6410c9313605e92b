"""A database far away: `hapticdb feel` on PostgreSQL behind a delay of the network.

    python benchmarks/far_away.py              # the vintage car, or the sample car: two minutes
    python benchmarks/far_away.py --quick      # short sessions, into results-quick/

A relay on the loopback interface holds back whatever passes between `feel` and the server for half
of a round trip each way. A spanner slides over the model, and the cells are new wherever it comes.
HAPTICDB_SERVER is the URL of a server to use instead of one of its own, in whose database an
environment may be made.
"""

import argparse
import contextlib
import os
import queue
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, urlencode, urlsplit

import hapticdb
import page_tables
import records
from hapticdb import GridOptions, ImportOptions
from hapticdb.sample import write_sample
from hapticdb.store.postgres.address import with_environment
from in_real_time import CAR, EXTENT, FRAMES, SETTINGS, session
from postgres_servers import find_binaries, serving
from slide_paths import write_along

ROUND_TRIPS = (0.0, 5e-3, 50e-3)
"""Seconds that the relay adds to a round trip."""
SPEEDS = (0.2, 1.0)
"""Speeds of the hand, m/s."""
RATE = 1000
"""Frames a second."""


class Relay:
    """A port of the loopback interface, at which a server answers `seconds` a round trip later."""

    def __init__(self, url: str, seconds: float) -> None:
        self._delay = 0.5 * seconds
        parts = urlsplit(url)
        words = {name: values[-1] for name, values in parse_qs(parts.query).items()}
        host = words.pop("host", None) or parts.hostname or "127.0.0.1"
        port = int(words.pop("port", None) or parts.port or 5432)
        self._target = f"{host}/.s.PGSQL.{port}" if host.startswith("/") else (host, port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        user = parts.netloc.rpartition("@")[0] or quote(words.pop("user", ""), safe="")
        place = f"127.0.0.1:{self._listener.getsockname()[1]}"
        place = f"{user}@{place}" if user else place
        self.url = f"postgresql://{place}{parts.path}?{urlencode(words)}"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Take no more connections; those that there are end with their clients."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                kind = socket.AF_UNIX if isinstance(self._target, str) else socket.AF_INET
                server = socket.socket(kind)
                server.connect(self._target)
                for end in (client, server):
                    if end.family == socket.AF_INET:
                        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                for source, target in ((client, server), (server, client)):
                    held = queue.SimpleQueue[tuple[float, bytes]]()
                    for work, end in ((self._take, source), (self._give, target)):
                        threading.Thread(target=work, args=(end, held), daemon=True).start()

    def _take(self, source: socket.socket, held: "queue.SimpleQueue[tuple[float, bytes]]") -> None:
        block = b"-"
        while block:
            try:
                block = source.recv(1 << 16)
            except OSError:
                block = b""
            held.put((time.monotonic() + self._delay, block))

    @staticmethod
    def _give(target: socket.socket, held: "queue.SimpleQueue[tuple[float, bytes]]") -> None:
        with contextlib.suppress(OSError):
            for due, block in iter(held.get, None):  # `_take` ends with an empty block
                time.sleep(max(due - time.monotonic(), 0.0))
                if not block:
                    break
                target.sendall(block)
        with contextlib.suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)


@contextlib.contextmanager
def server_url(folder: Path) -> Iterator[str]:
    """URL of the given server, or of a private one."""
    if given := os.environ.get("HAPTICDB_SERVER"):
        yield given
        return
    with serving(folder / "server", find_binaries()[0], SETTINGS) as server:
        yield server.conninfo()


def measure(folder: Path, model: Path | None, bits: int, seconds: float) -> dict[str, Any]:
    """One session a speed and round trip."""
    sample = write_sample(folder)
    options = ImportOptions(grid=GridOptions(bits=bits, extent=EXTENT))
    cells = []
    with server_url(folder) as server:
        url = with_environment(server, "far_away")
        hapticdb.import_files(url, [model or sample.car], options)
        tool, path = sample.spanner, sample.path
        if model is not None:
            tool, path = write_along(folder / "along", url, FRAMES)
        for speed in SPEEDS:
            for round_trip in ROUND_TRIPS:
                with contextlib.closing(Relay(url, round_trip)) as relay:
                    words = "--speed", str(speed), "--no-baseline"
                    found = session(relay.url, tool, path, RATE, seconds, *words)
                kept = {name: found[name] for name in ("loop", "unknown_frames", "cache")}
                cells.append({"speed": speed, "round_trip": round_trip} | kept)
    inputs = {"model": (model or Path(sample.car)).name, "bits": bits, "rate": RATE}
    return records.result("far away", cells, inputs)


def main() -> None:
    """Measure, and fill the table of docs/realtime.md."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="short sessions, a coarse sample")
    given = parser.parse_args()
    out = Path("results-quick" if given.quick else "results")
    real = Path(os.environ.get("HAPTICDB_TEST_DATA", ""), CAR)
    model = None if given.quick or not real.is_file() else real
    with tempfile.TemporaryDirectory(prefix="hapticdb-far-") as folder:
        found = measure(Path(folder), model, *((8, 2.0) if given.quick else (11, 10.0)))
    records.write(out, {"far_away": found})
    if not given.quick:
        page_tables.refill("docs/realtime.md", out)


if __name__ == "__main__":
    main()
