"""Opens, makes and copies environments by their URLs, and grants rights on them."""

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
from hapticdb.store.refusals import wants_distances
from hapticdb.store.urls import redact


def open_store(url: Url, *, read_only: bool = False) -> Store:
    """Open an existing environment: a bare path, ``sqlite:///path``, ``postgresql://...``."""
    return engine_of(url).open(os.fspath(url), read_only=read_only)


def create_store(
    url: Url, grid: Grid, layout: Layout = "brick", *, distances: bool | None = False
) -> Store:
    """Make a new environment; bricks need a hierarchical curve.

    distances : whether imported parts get distances to their surfaces; None for a layout's own.
    """
    if layout not in LAYOUTS:
        raise UsageError(f"layout {layout!r}: choose one of {', '.join(LAYOUTS)}")
    check_curve(grid.curve, layout)
    wish = wants_distances(layout, distances)
    return engine_of(url).create(os.fspath(url), grid, layout, distances=wish)


def exists(url: Url) -> bool:
    """Whether something is there already, an environment or not."""
    return engine_of(url).exists(os.fspath(url))


def grant(url: Url, role: str, right: Right) -> None:
    """Give a role of the server one right on an environment; see `hapticdb.store.postgres.rights`.

    Raises `AccessError` for another user than the owner; `UsageError` when there is no such role,
    when the role may do everything anyway, or when the engine has no roles.
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

    file : path of the copy, an environment, too, which appears whole or not at all
    replace : replace an environment that is there, and its log, unless somebody has it open: after
        the copy is whole beside it. So a copy is put back, too.
    progress : called after each 4 MiB with the bytes done and in all

    Raises `EnvironmentExistsError` when `file` is there and `replace` is false; `BusyError` when it
    is open, unless by a reader that cannot write the folder; `NotAnEnvironmentError` when it is no
    environment; `DamagedError`, and replaces nothing, when the copy is damaged; `UsageError` when
    either is on PostgreSQL, or both are one file.
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
