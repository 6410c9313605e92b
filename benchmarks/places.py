"""Private servers of PostgreSQL for as long as a benchmark needs them."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from hapticdb.store.postgres.private_server import Binaries, PrivateServer


@contextlib.contextmanager
def serving(
    folder: Path, binaries: Binaries, settings: Mapping[str, str]
) -> Iterator[PrivateServer]:
    """A server in a folder, with the given settings, that runs inside the block."""
    server = PrivateServer.at(folder, binaries, settings)
    server.start()
    try:
        yield server
    finally:
        server.stop()
