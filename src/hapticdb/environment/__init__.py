"""An opened database: what is asked about a tool, and what changes the scene."""

import os

from hapticdb.environment.opened import Environment
from hapticdb.grid import Grid
from hapticdb.store.base import Layout
from hapticdb.store.connect import create_store, open_store

__all__ = ["Environment", "create", "open"]


def open(url: str | os.PathLike[str], *, read_only: bool = False) -> Environment:  # noqa: A001 - the word users expect, as in tarfile.open
    """Open an environment.

    url : a path, ``sqlite:///path``, or ``postgresql://user@host/database?environment=NAME``;
    read_only : refuse every write; works on files and folders that cannot be written.

    Raises `EnvironmentNotFoundError`, `NotAnEnvironmentError`, `NewerVersionError` or
    `DamagedError` if there is no environment, something else, or one that cannot be read.
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

    layout : rows of its index table; distances : whether parts get distances for the force law
    distance; bricks do unless told otherwise.

    Raises `EnvironmentExistsError` if something exists there already; `UsageError` for bricks in
    lexicographic order, or distances on the layout voxel.
    """
    return Environment(create_store(url, grid, layout, distances=distances), url)
