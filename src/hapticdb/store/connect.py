"""Opening, creating and copying environments by URL; rights on them."""

import os

from hapticdb.errors import UsageError
from hapticdb.grid import Grid
from hapticdb.store.base import LAYOUTS, Layout, Progress, Store
from hapticdb.store.engines import (
    BackupReport,
    Right,
    SupportsBackup,
    SupportsGrant,
    Url,
    engine_of,
)
from hapticdb.store.store_errors import wants_distances
from hapticdb.store.urls import redact


def open_store(url: Url, *, read_only: bool = False) -> Store:
    """Open an existing environment: a bare path, ``sqlite:///path``, ``postgresql://...``."""
    return engine_of(url).open(os.fspath(url), read_only=read_only)


def create_store(
    url: Url, grid: Grid, layout: Layout = "brick", *, distances: bool | None = False
) -> Store:
    """Make a new environment; bricks need a hierarchical curve.

    distances : whether imports compute distances to the parts' surfaces; None for the layout's
    default.
    """
    if layout not in LAYOUTS:
        raise UsageError(f"layout {layout!r}: choose one of {', '.join(LAYOUTS)}")
    check_curve(grid.curve, layout)
    wish = wants_distances(layout, distances)
    return engine_of(url).create(os.fspath(url), grid, layout, distances=wish)


def exists(url: Url) -> bool:
    """Whether the file or schema exists, an environment or not."""
    return engine_of(url).exists(os.fspath(url))


def grant(url: Url, role: str, right: Right) -> None:
    """Grant one right on an environment to a role of the server: `store.postgres.rights`.

    Raises `AccessError` for a user other than the owner; `UsageError` for an unknown role, a role
    with all rights anyway, or an engine without roles.
    """
    engine = engine_of(url)
    if not isinstance(engine, SupportsGrant):
        raise UsageError(
            f"{redact(os.fspath(url))} is on {engine.title}, which has no roles: use the file "
            "system's rights"
        )
    engine.grant(os.fspath(url), role, right)


def backup_environment(
    url: Url,
    file: Url,
    *,
    replace: bool = False,
    progress: Progress | None = None,
) -> BackupReport:
    """Copy a whole SQLite environment as of one moment, while others read and write it.

    file : path of the copy, an environment, too; created whole or not at all
    replace : replace an existing environment and its log, unless it is open in any process, once
        the new copy is whole beside it; this also restores a copy
    progress : called after each 4 MiB with the bytes done and in all

    Raises `EnvironmentExistsError` when `file` exists and `replace` is false; `BusyError` when it
    is open, except by a reader without write access to the folder; `NotAnEnvironmentError` when it
    is no environment; `DamagedError`, and replaces nothing, when the copy is damaged; `UsageError`
    when either is on PostgreSQL, or both are one file.
    """
    engine, other = engine_of(url), engine_of(file)
    if not isinstance(engine, SupportsBackup):
        raise UsageError(
            f"{redact(os.fspath(url))} is on {engine.title}, not a file: use its own tools, or "
            "'hapticdb copy'"
        )
    if other is not engine:
        raise UsageError(f"{redact(os.fspath(file))} is on {other.title}, not a file: give a path")
    return engine.back_up(os.fspath(url), os.fspath(file), replace=replace, progress=progress)


def check_curve(curve: str, layout: Layout) -> None:
    """Refuse bricks in lexicographic order: leading bits of such a key name no cube."""
    if layout == "brick" and curve == "lexicographic":
        raise UsageError(
            "bricks need a hierarchical curve: choose z or hilbert, or the layout voxel"
        )
