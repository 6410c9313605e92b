"""A URL picks the engine: nothing else in the code knows which one it is."""

import os
from pathlib import Path

from hapticdb.errors import UsageError
from hapticdb.grid import Grid
from hapticdb.store.base import LAYOUTS, Layout, Store
from hapticdb.store.sqlite import SQLiteStore

SQLITE_SCHEME = "sqlite:///"


def open_store(url: str | os.PathLike[str], *, read_only: bool = False) -> Store:
    """Open an existing environment: a bare path or ``sqlite:///path``."""
    return SQLiteStore.open(_path_of(url), read_only=read_only)


def create_store(url: str | os.PathLike[str], grid: Grid, layout: Layout = "brick") -> Store:
    """Make a new environment; bricks need a hierarchical curve."""
    if layout not in LAYOUTS:
        raise UsageError(f"layout {layout!r}: choose one of {', '.join(LAYOUTS)}")
    check_curve(grid.curve, layout)
    return SQLiteStore.create(_path_of(url), grid, layout)


def exists(url: str | os.PathLike[str]) -> bool:
    """Whether something is there already, an environment or not."""
    return _path_of(url).exists()


def check_curve(curve: str, layout: Layout) -> None:
    """Refuse bricks in an order whose leading bits name no cube."""
    if layout == "brick" and curve == "lexicographic":
        raise UsageError(
            "bricks need a hierarchical curve: choose z or hilbert, or the layout voxel"
        )


def _path_of(url: str | os.PathLike[str]) -> Path:
    text = os.fspath(url)
    if text.startswith(SQLITE_SCHEME):
        text = text.removeprefix(SQLITE_SCHEME)
    elif "://" in text:
        scheme = text.split("://", 1)[0]
        raise UsageError(f"scheme {scheme!r}: give a path, or sqlite:///path")
    if not text:
        raise UsageError("an empty path: name the environment's file")
    if text.startswith((":memory:", "file:")):
        raise UsageError(f"{text!r}: an environment is a file; give its path")
    return Path(text)
