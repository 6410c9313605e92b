"""PostgreSQL as an engine: ``postgresql://...``, one schema an environment."""

from hapticdb.grid import Grid
from hapticdb.store.base import Layout, Store
from hapticdb.store.engines import Right
from hapticdb.store.postgres import rights, schema_of
from hapticdb.store.postgres.address import parse, with_environment
from hapticdb.store.postgres.store import PostgresStore


class _PostgresEngine:
    """Environments on servers."""

    title = "PostgreSQL"

    def open(self, url: str, *, read_only: bool) -> Store:
        """Connect to an existing environment; ``?data=FOLDER`` starts its private server."""
        return PostgresStore.open(url, read_only=read_only)

    def create(self, url: str, grid: Grid, layout: Layout, *, distances: bool = False) -> Store:
        """Make a schema, which appears whole or not at all; ``?data=FOLDER`` makes the server."""
        return PostgresStore.create(url, grid, layout, distances=distances)

    def exists(self, url: str) -> bool:
        """Whether a schema of that name is there. Connects."""
        return schema_of.exists(url)

    def beside(self, url: str, ending: str) -> str:
        """URL of another schema in the same database."""
        return with_environment(url, parse(url).environment + ending)

    def grant(self, url: str, role: str, right: Right) -> None:
        """Give a role of the server one right; see `hapticdb.store.postgres.rights`."""
        with schema_of.connected(url) as connection:
            schema_of.check(connection)
            rights.grant(connection, role, right)


ENGINE = _PostgresEngine()
