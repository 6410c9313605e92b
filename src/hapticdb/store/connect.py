"""A URL picks the engine: nothing else in the code knows which one it is."""

import os
from importlib.util import find_spec
from pathlib import Path

from hapticdb.errors import MissingExtraError, UsageError
from hapticdb.grid import Grid
from hapticdb.store.base import LAYOUTS, Layout, Store
from hapticdb.store.postgres import address
from hapticdb.store.postgres.address import redact
from hapticdb.store.sqlite import SQLiteStore

__all__ = ["beside", "check_curve", "create_store", "exists", "open_store", "redact"]

SQLITE_SCHEME = "sqlite:///"


def open_store(url: str | os.PathLike[str], *, read_only: bool = False) -> Store:
    """Open an existing environment: a bare path, ``sqlite:///path``, ``postgresql://...``."""
    if _is_postgres(url):
        from hapticdb.store.postgres.store import PostgresStore  # noqa: PLC0415 - an extra

        return PostgresStore.open(os.fspath(url), read_only=read_only)
    return SQLiteStore.open(_path_of(url), read_only=read_only)


def create_store(url: str | os.PathLike[str], grid: Grid, layout: Layout = "brick") -> Store:
    """Make a new environment; bricks need a hierarchical curve."""
    if layout not in LAYOUTS:
        raise UsageError(f"layout {layout!r}: choose one of {', '.join(LAYOUTS)}")
    check_curve(grid.curve, layout)
    if _is_postgres(url):
        from hapticdb.store.postgres.store import PostgresStore  # noqa: PLC0415 - an extra

        return PostgresStore.create(os.fspath(url), grid, layout)
    return SQLiteStore.create(_path_of(url), grid, layout)


def exists(url: str | os.PathLike[str]) -> bool:
    """Whether something is there already, an environment or not."""
    if _is_postgres(url):
        from hapticdb.store.postgres import schema_of  # noqa: PLC0415 - an extra

        return schema_of.exists(os.fspath(url))
    return _path_of(url).exists()


def beside(url: str | os.PathLike[str], name: str) -> str:
    """URL of another environment at the same place: in the same folder, or the same database."""
    if _is_postgres(url):
        return address.with_environment(os.fspath(url), name)
    return str(_path_of(url).with_name(f"{name}.db"))


def check_curve(curve: str, layout: Layout) -> None:
    """Refuse bricks in an order whose leading bits name no cube."""
    if layout == "brick" and curve == "lexicographic":
        raise UsageError(
            "bricks need a hierarchical curve: choose z or hilbert, or the layout voxel"
        )


def _is_postgres(url: str | os.PathLike[str]) -> bool:
    """Whether a URL means PostgreSQL; refuses it when the driver is not installed."""
    if not isinstance(url, str) or not address.is_postgres(url):
        return False
    if find_spec("psycopg") is None:
        raise MissingExtraError(
            f"{redact(url)} needs psycopg: install it with pip install 'hapticdb[postgres]'"
        )
    return True


def _path_of(url: str | os.PathLike[str]) -> Path:
    text = os.fspath(url)
    if text.startswith(SQLITE_SCHEME):
        text = text.removeprefix(SQLITE_SCHEME)
    elif "://" in text:
        scheme = text.split("://", 1)[0]
        raise UsageError(
            f"scheme {scheme!r}: give a path, sqlite:///path, or postgresql://host/database"
        )
    if not text:
        raise UsageError("an empty path: name the environment's file")
    if text.startswith((":memory:", "file:")):
        raise UsageError(f"{text!r}: an environment is a file; give its path")
    return Path(text)
