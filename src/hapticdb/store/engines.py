"""Engines by URL scheme, imported on first use: a verb on a file loads no driver."""

import os
from importlib import import_module
from typing import Literal, NamedTuple, Protocol, cast, runtime_checkable

from hapticdb.errors import MissingExtraError, UsageError, pip_line
from hapticdb.grid import Grid
from hapticdb.store.base import Layout, Progress, Store
from hapticdb.store.urls import redact, scheme_of

Url = str | os.PathLike[str]
Right = Literal["viewer", "toucher", "editor", "nobody"]
"""Rights of a role: read and query; also store cost figures; also edit; none."""


class BackupReport(NamedTuple):
    """Result of a backup: the copy's revision, number of objects, and bytes of its file."""

    source: str
    target: str
    revision: int
    objects: int
    bytes: int


class Engine(Protocol):
    """Operations of an engine on URLs, before a store is open: methods of its class of stores.

    URLs are unchanged user input. All methods may connect.

    title : name of the engine in messages: ``PostgreSQL``.
    """

    title: str

    def open(self, url: str, *, read_only: bool) -> Store:
        """Open an existing environment.

        Raises EnvironmentNotFoundError, NotAnEnvironmentError, NewerVersionError or DamagedError.
        """

    def create(self, url: str, grid: Grid, layout: Layout, *, distances: bool = False) -> Store:
        """Make a new environment; raises EnvironmentExistsError when the file or schema exists.

        distances : its `Store.wants_distances`; false on the layout voxel.
        """

    def exists(self, url: str) -> bool:
        """Whether the file or schema exists, an environment or not. May connect."""


@runtime_checkable
class SupportsGrant(Protocol):
    """An engine that has users, and enforces the rights of each."""

    def grant(self, url: str, role: str, right: Right) -> None:
        """Grant one right on an environment to a role, instead of its former one."""


class Lag(NamedTuple):
    """Lag of a standby behind its primary, by the standby's own figures.

    replayed : position in the primary's log; seconds : since the last replayed commit, None before
    the first. It grows without writes, too.
    """

    replayed: str
    seconds: float | None


@runtime_checkable
class MayLag(Protocol):
    """An opened store possibly served by a standby."""

    def lag(self) -> Lag | None:
        """Lag of the server; None for a primary."""


@runtime_checkable
class DropsRows(Protocol):
    """An opened store in which a crash can leave orphan rows: rows without an object."""

    def drop_rows(self, object_id: int) -> None:
        """Delete the orphan rows of an id; no effect if the object exists."""


@runtime_checkable
class SupportsBackup(Protocol):
    """An engine that copies a whole environment as of one moment."""

    def back_up(
        self, url: str, copy: str, *, replace: bool, progress: Progress | None
    ) -> BackupReport:
        """Copy an environment while others read and write it; `copy` is an environment, too."""


FOLDERS = {"": "sqlite", "sqlite": "sqlite", "postgresql": "postgres", "postgres": "postgres"}
"""Subpackage of an engine, by URL scheme; a path has no scheme."""


def engine_of(url: Url) -> Engine:
    """Engine of a URL or a path.

    Raises `UsageError` for an unknown scheme; `MissingExtraError` without the engine's driver.
    """
    # a Path object is a path, whatever its name
    scheme = scheme_of(url) if isinstance(url, str) else ""
    if scheme not in FOLDERS:
        raise unknown_scheme(scheme)
    folder = FOLDERS[scheme]
    if folder == "postgres":
        try:
            import_module("psycopg")
        except ImportError as error:  # the driver, or a library that it loads, is missing
            raise MissingExtraError(
                f"{redact(os.fspath(url))} needs psycopg: install it with {pip_line('postgres')}"
            ) from error
    # imported here: a path loads no driver of a server
    return cast("Engine", import_module(f"hapticdb.store.{folder}.{folder}_store").ENGINE)


def unknown_scheme(scheme: str) -> UsageError:
    """Build the error for a URL of no engine."""
    return UsageError(
        f"scheme {scheme!r}: give a path, sqlite:///path or postgresql://host/database"
    )
