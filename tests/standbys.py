"""A primary and its streaming standby, on Unix sockets in folders of their own, for tests."""

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import psycopg
import pytest

from children import finished, until
from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.private_server import Binaries, PrivateServer
from servers import FOUND, named
from servers import SETTINGS as FAST

SETTINGS = FAST | {"wal_keep_size": "256MB"}
"""Settings of all servers; a standby that was stopped finds the log that it has missed."""


class Pair:
    """A primary and a standby that streams from it.

    folder : where all of them are, one folder each; binaries : their version.
    """

    def __init__(self, folder: Path, binaries: Binaries) -> None:
        self.folder = folder
        self.primary = PrivateServer.at(folder / "primary", binaries, SETTINGS)
        self.primary.start()
        self.standby = self.add("standby")

    def add(self, name: str) -> PrivateServer:
        """Copy the primary, and start the copy as a standby."""
        place = self.folder / name
        place.mkdir(mode=0o700)
        (place / "lock").touch(mode=0o600)
        copied = [self.primary.binaries.path("pg_basebackup"), "--write-recovery-conf"]
        copied += ["--checkpoint=fast", "--no-sync", f"--pgdata={place / 'data'}"]
        finished([*copied, f"--dbname={self.primary.conninfo()}"], check=True)
        (place / "data").chmod(0o700)
        made = PrivateServer.at(place, self.primary.binaries, SETTINGS)
        made.start()
        return made

    def url(self, environment: str, *servers: PrivateServer, attrs: str = "prefer-standby") -> str:
        """URL of an environment on several of the servers; primary and standby if none is named."""
        servers = servers or (self.primary, self.standby)
        hosts = ",".join(_host(server) for server in servers)
        ports = ",".join("5432" for _ in servers)
        url = f"postgresql:///postgres?host={hosts}&port={ports}&user=hapticdb"
        return with_environment(f"{url}&target_session_attrs={attrs}", environment)

    def at_primary(self, environment: str) -> str:
        """URL of an environment on the primary alone."""
        return with_environment(self.primary.conninfo(), environment)

    @contextlib.contextmanager
    def paused(self, server: PrivateServer | None = None) -> Iterator[None]:
        """Inside, the standby replays nothing, and answers."""
        server = server or self.standby
        self.pause(server)
        try:
            yield
        finally:
            self.resume(server)

    def pause(self, server: PrivateServer) -> None:
        """Have a standby replay nothing from now on."""
        with psycopg.connect(server.conninfo(), autocommit=True) as connection:
            connection.execute("SELECT pg_wal_replay_pause()")

            def is_paused() -> bool:
                state = connection.execute("SELECT pg_get_wal_replay_pause_state()").fetchone()
                return state == ("paused",)

            until(is_paused)

    def resume(self, server: PrivateServer) -> None:
        """Have a standby replay again."""
        with psycopg.connect(server.conninfo(), autocommit=True) as connection:
            connection.execute("SELECT pg_wal_replay_resume()")

    def await_replay(self, server: PrivateServer | None = None) -> None:
        """Wait until a standby has replayed all that the primary has written now."""
        server = server or self.standby
        with (
            psycopg.connect(self.primary.conninfo(), autocommit=True) as there,
            psycopg.connect(server.conninfo(), autocommit=True) as here,
        ):
            row = there.execute("SELECT pg_current_wal_flush_lsn()::text").fetchone()
            assert row is not None
            reached = "SELECT pg_last_wal_replay_lsn() >= %s::pg_lsn"
            until(lambda: here.execute(reached, row).fetchone() == (True,))

    def close(self) -> None:
        """End all servers, and remove their folders."""
        for place in self.folder.iterdir():
            PrivateServer.at(place, self.primary.binaries, SETTINGS).kill()


def _host(server: PrivateServer) -> str:
    (host,) = parse_qs(urlsplit(server.conninfo()).query)["host"]
    return host


@contextlib.contextmanager
def pair_of(binaries: Binaries) -> Iterator[Pair]:
    """A primary and a standby, removed at the end."""
    folder = Path(tempfile.mkdtemp(prefix="standby-")).resolve()
    try:
        pair = Pair(folder, binaries)
        try:
            yield pair
        finally:
            pair.close()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module", params=[b for b in FOUND if not isinstance(b, str)], ids=named)
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    with pair_of(request.param) as made:
        yield made
