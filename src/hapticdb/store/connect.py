"""A URL picks the engine: nothing else in the code knows which one it is."""

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from hapticdb.errors import MissingExtraError, UsageError
from hapticdb.grid import Grid
from hapticdb.store.base import LAYOUTS, Layout, Store
from hapticdb.store.postgres import address
from hapticdb.store.postgres.address import redact
from hapticdb.store.sqlite import checking as sqlite_check
from hapticdb.store.sqlite.store import SQLiteStore

if TYPE_CHECKING:
    from hapticdb.store.postgres.rights import Right
    from hapticdb.store.sqlite.backup import BackupReport, ProgressCallback

__all__ = [
    "backup_environment",
    "beside",
    "check_curve",
    "create_store",
    "exists",
    "findings_before_opening",
    "grant",
    "name_of",
    "open_store",
    "redact",
    "restore_environment",
]

SQLITE_SCHEME = "sqlite:///"
# what libpq takes beside URLs, and a URL without its slashes
KEYWORDS = re.compile(r"^postgres(ql)?:|(^|\s)\w*password\s*=", re.IGNORECASE)


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


def findings_before_opening(url: str | os.PathLike[str]) -> list[str]:
    """What is wrong with an environment's file, as far as that shows before it is opened."""
    if _is_postgres(url):
        return []
    return sqlite_check.first_findings(_path_of(url))


def beside(url: str | os.PathLike[str], name: str) -> str:
    """URL of another environment at the same place: in the same folder, or the same database."""
    if _is_postgres(url):
        return address.with_environment(os.fspath(url), name)
    return str(_path_of(url).with_name(f"{name}.db"))


def grant(url: str | os.PathLike[str], role: str, right: "Right") -> None:
    """Give a role of the server one right on an environment; see `hapticdb.store.postgres.rights`.

    Raises
    ------
    AccessError
        When the URL's user does not own the environment.
    UsageError
        When there is no such role, or none that could be held back; for a file.
    """
    if not _is_postgres(url):
        raise UsageError(f"{_path_of(url)}: a file has no roles: use the file system's rights")
    from hapticdb.store.postgres import rights, schema_of  # noqa: PLC0415 - an extra

    with schema_of.connected(os.fspath(url)) as session:
        schema_of.check(session)
        rights.grant(session, role, right)


def backup_environment(
    url: str | os.PathLike[str],
    file: str | os.PathLike[str],
    *,
    replace: bool = False,
    progress: "ProgressCallback | None" = None,
) -> "BackupReport":
    """Copy an SQLite environment whole, as of one moment, while others go on reading and writing.

    Parameters
    ----------
    url : str or path
        The environment: a path or ``sqlite:///path``.
    file : path
        Where the copy goes: an environment of its own, which can be opened. It appears whole, on
        disk, or not at all.
    replace : bool
        Replace an environment that is there, unless somebody has it open.
    progress : callable or None
        Called after each 4 MiB with `bytes_done` and `bytes_total`.

    Raises
    ------
    EnvironmentExistsError
        When `file` is there and `replace` is false.
    BusyError
        When the file that is to be replaced is open.
    DamagedError
        When a page is not what was written: nothing is left then.
    UsageError
        When either is on PostgreSQL, or both are one file.
    """
    from hapticdb.store.sqlite.backup import back_up  # noqa: PLC0415 - seldom needed

    _refuse_server(url, "pg_dump copies it")
    _refuse_server(file, "give a path")
    return back_up(_path_of(url), _path_of(file), replace=replace, progress=progress)


def restore_environment(
    file: str | os.PathLike[str],
    url: str | os.PathLike[str],
    *,
    progress: "ProgressCallback | None" = None,
) -> "BackupReport":
    """Put a copy of an SQLite environment in its place, and remove the log of what was there.

    The former file stays until the copy is whole beside it. `file` stays as it is.

    Parameters
    ----------
    file : path
        A copy that `backup_environment` made, or any other environment's file.
    url : str or path
        Where it goes: a path or ``sqlite:///path``, whether something is there or not.
    progress : callable or None
        Called after each 4 MiB with `bytes_done` and `bytes_total`.

    Raises
    ------
    BusyError
        When the environment that is to be replaced is open, where that can be known: a reader in a
        folder that it cannot write leaves no sign.
    NotAnEnvironmentError
        When a file of another kind is in the place.
    DamagedError
        When a page of `file` is not what was written: nothing has changed then.
    UsageError
        When either is on PostgreSQL, or both are one file.
    """
    from hapticdb.store.sqlite.backup import back_up  # noqa: PLC0415 - seldom needed

    _refuse_server(file, "give a path")
    _refuse_server(url, "pg_restore puts a copy into it")
    return back_up(_path_of(file), _path_of(url), replace=True, progress=progress)


def _refuse_server(url: str | os.PathLike[str], what_next: str) -> None:
    if isinstance(url, str) and address.is_postgres(url):
        raise UsageError(f"{redact(url)} is on PostgreSQL, not a file: {what_next}")


def name_of(url: str | os.PathLike[str]) -> str:
    """Name of the environment that a URL means: a schema, or a file without its ending."""
    if _is_postgres(url):
        return address.parse(os.fspath(url)).environment
    return _path_of(url).stem


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
    try:
        import psycopg  # noqa: F401, PLC0415 - an extra
    except ImportError as error:  # it is not there, or finds no libpq
        raise MissingExtraError(
            f"{redact(url)} needs psycopg: install it with pip install 'hapticdb[postgres]'"
        ) from error
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
    if KEYWORDS.search(text):  # not shown: it holds a password
        raise UsageError("libpq's keywords are not read here: give postgresql://user@host/database")
    if not text:
        raise UsageError("an empty path: name the environment's file")
    if text.startswith((":memory:", "file:")):
        raise UsageError(f"{text!r}: an environment is a file; give its path")
    return Path(text)
