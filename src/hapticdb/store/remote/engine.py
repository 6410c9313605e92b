"""Environments behind hapticdb servers as an engine: ``ws://`` and ``wss://``, to read."""

from collections.abc import Mapping
from types import MappingProxyType

from hapticdb.errors import EnvironmentNotFoundError, ReadOnlyError, UsageError
from hapticdb.grid import Grid
from hapticdb.store.base import Layout, Store
from hapticdb.store.engines import Capability
from hapticdb.store.remote.store import RemoteStore
from hapticdb.store.urls import parse_address


class RemoteEngine:
    """Environments that a server lends, one a URL."""

    title = "a hapticdb server"
    lacks: Mapping[Capability, str] = MappingProxyType(
        {
            "grant": " is behind a server: its tokens give rights, see 'hapticdb serve'",
            "backup": " is behind a server: run 'hapticdb backup' where its file is",
            "restore": " is behind a server: run 'hapticdb restore' where its file is",
        }
    )

    def open(self, url: str, *, read_only: bool) -> Store:  # noqa: ARG002 - it always is
        """Connect to a server's environment, to read only."""
        return RemoteStore(url)

    def create(
        self,
        url: str,
        grid: Grid,  # noqa: ARG002 - refused
        layout: Layout,  # noqa: ARG002
        *,
        distances: bool = False,  # noqa: ARG002
    ) -> Store:
        """Refuse: a server's environment is made where the server is."""
        shown = parse_address(url).shown
        raise ReadOnlyError(f"{shown} is behind a server: make the environment where the server is")

    def exists(self, url: str) -> bool:
        """Whether a server answers there. Connects."""
        try:
            RemoteStore(url).close()
        except EnvironmentNotFoundError:
            return False
        return True

    def beside(self, url: str, name: str) -> str:
        """Refuse: a server has one environment."""
        shown = parse_address(url).shown
        raise UsageError(f"{shown} is behind a server, which has no environment {name!r} beside it")

    def name_of(self, url: str) -> str:
        """Host, port and prefix."""
        return parse_address(url).name


ENGINE = RemoteEngine()
