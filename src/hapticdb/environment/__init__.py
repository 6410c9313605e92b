"""Environment: an opened database, with queries for a tool and edits of the scene."""

import os

from hapticdb.environment.opened import Environment
from hapticdb.grid import Grid
from hapticdb.store.base import Layout
from hapticdb.store.connect import create_store, open_store

__all__ = ["Environment", "create", "open"]


def open(url: str | os.PathLike[str], *, read_only: bool = False) -> Environment:  # noqa: A001 - as tarfile.open
    """Open an environment.

    url : a path, ``sqlite:///path``, or ``postgresql://user@host/database?environment=NAME``;
    read_only : refuse every write; works on files and folders without write access.

    Raises `EnvironmentNotFoundError`, `NotAnEnvironmentError`, `NewerVersionError` or
    `DamagedError` if there is no environment, something else, or an unreadable one.
    """
    return Environment(open_store(url, read_only=read_only), url)


def create(
    url: str | os.PathLike[str],
    grid: Grid,
    *,
    layout: Layout = "brick",
    distances: bool | None = None,
) -> Environment:
    """Make an environment with a given grid and open it.

    layout : rows of its index table; distances : whether imports compute distances, for the force
    law distance; unless given, with bricks.

    Raises `EnvironmentExistsError` for an existing file or schema; `UsageError` for bricks in
    lexicographic order, or distances on the layout voxel.
    """
    return Environment(create_store(url, grid, layout, distances=distances), url)
