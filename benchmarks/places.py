"""Places of the environments of all sizes on each engine, with 4 MB of page cache."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Protocol

from hapticdb.errors import UsageError
from hapticdb.store.connect import exists
from hapticdb.store.postgres import schema_of
from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.private_server import Binaries, PrivateServer, find_binaries
from hapticdb.store.sqlite.file import remove_file

CACHE = "4 MB"
"""Page cache of each engine: the paper's 500 blocks of 8 KB."""
SETTINGS = {"shared_buffers": "4MB", "max_wal_size": "2GB"}


class EnginePlace(Protocol):
    """Where one engine keeps the environments of all sizes."""

    kind: str

    def url(self, name: str) -> str:
        """URL of an environment."""

    def remove(self, name: str) -> None:
        """Delete an environment, complete or not."""


class Files:
    """SQLite: a file each."""

    kind = "sqlite"

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def url(self, name: str) -> str:
        return str(self._folder / f"{name}.db")

    def remove(self, name: str) -> None:
        remove_file(Path(self.url(name)))


class Server:
    """PostgreSQL: a schema each, on a running server that has 4 MB for all its pages."""

    kind = "postgres"

    def __init__(self, conninfo: str) -> None:
        self._conninfo = conninfo

    def url(self, name: str) -> str:
        return with_environment(self._conninfo, name)

    def remove(self, name: str) -> None:
        if exists(self.url(name)):
            with contextlib.closing(schema_of.connected(self.url(name))) as session:
                schema_of.drop(session)


@contextlib.contextmanager
def place_of(engine: str, folder: Path) -> Iterator[EnginePlace]:
    """Prepare the place of an engine: ``sqlite``, or a major version of PostgreSQL."""
    if engine == "sqlite":
        yield Files(folder)
        return
    with serving(folder / f"postgres{engine}", _binaries(engine), SETTINGS) as server:
        yield Server(server.conninfo())


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


def _binaries(engine: str) -> Binaries:
    found = {str(binaries.major): binaries for binaries in find_binaries()}
    if engine not in found:
        raise UsageError(
            f"engine {engine!r}: choose sqlite or a PostgreSQL that is installed here "
            f"({', '.join(found) or 'none'})"
        )
    return found[engine]
