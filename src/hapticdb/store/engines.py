"""Engines by the schemes of URLs, imported when first named: a verb on a file loads no driver."""

import os
from importlib import import_module
from typing import Literal, NamedTuple, Protocol, cast, runtime_checkable

from hapticdb.errors import MissingExtraError, UsageError, pip_line
from hapticdb.grid import Grid
from hapticdb.store.base import Layout, Progress, Store
from hapticdb.store.urls import redact, scheme_of

Url = str | os.PathLike[str]
Right = Literal["viewer", "toucher", "editor", "nobody"]
"""Rights of a role: read and touch; also keep cost figures; also edit; nothing."""


class BackupReport(NamedTuple):
    """Result of a backup: the copy's revision, number of objects, and bytes of its file."""

    source: str
    target: str
    revision: int
    objects: int
    bytes: int


class Engine(Protocol):
    """What an engine does with URLs, before a store is open.

    URLs come as the user wrote them. Only the methods that say so connect to anything.

    title : its name in messages: ``PostgreSQL``.
    """

    title: str

    def open(self, url: str, *, read_only: bool) -> Store:
        """Open an existing environment.

        Raises EnvironmentNotFoundError, NotAnEnvironmentError, NewerVersionError or DamagedError.
        """

    def create(self, url: str, grid: Grid, layout: Layout, *, distances: bool = False) -> Store:
        """Make a new environment; raises EnvironmentExistsError when something is there.

        distances : its `Store.wants_distances`; false on the layout voxel.
        """

    def exists(self, url: str) -> bool:
        """Whether something is there already, an environment or not. May connect."""


@runtime_checkable
class SupportsGrant(Protocol):
    """An engine that has users, and stores the rights of each."""

    def grant(self, url: str, role: str, right: Right) -> None:
        """Give a role one right on an environment; it replaces the role's former one."""


class Lag(NamedTuple):
    """How far a standby is behind its primary, as the standby states it.

    replayed : position in the primary's log; seconds : since the last replayed commit, None before
    the first. They grow where nothing is written, too.
    """

    replayed: str
    seconds: float | None


@runtime_checkable
class MayLag(Protocol):
    """An opened store whose answers may come from a standby."""

    def lag(self) -> Lag | None:
        """How far the server that answers is behind; None if it is no standby."""


@runtime_checkable
class DropsRows(Protocol):
    """An opened store in which a crash may leave rows of an object that is not there."""

    def drop_rows(self, object_id: int) -> None:
        """Delete such rows; nothing if there is an object of that id."""


@runtime_checkable
class SupportsBackup(Protocol):
    """An engine that copies a whole environment as of one moment."""

    def back_up(
        self, url: str, copy: str, *, replace: bool, progress: Progress | None
    ) -> BackupReport:
        """Copy an environment while others read and write it; `copy` is an environment, too."""


FOLDERS = {"": "sqlite", "sqlite": "sqlite", "postgresql": "postgres", "postgres": "postgres"}
"""Folder of an engine's modules, by the scheme of a URL; a path has no scheme."""


def engine_of(url: Url) -> Engine:
    """Engine of a URL or a path.

    Raises `UsageError` for an unknown scheme; `MissingExtraError` without the engine's driver.
    """
    # a Path object is a path, whatever its name looks like
    scheme = scheme_of(url) if isinstance(url, str) else ""
    if scheme not in FOLDERS:
        raise unknown_scheme(scheme)
    folder = FOLDERS[scheme]
    if folder == "postgres":
        try:
            import_module("psycopg")
        except ImportError as error:  # the driver is missing, or does not find its own library
            raise MissingExtraError(
                f"{redact(os.fspath(url))} needs psycopg: install it with {pip_line('postgres')}"
            ) from error
    return cast("Engine", import_module(f"hapticdb.store.{folder}.store").ENGINE)


def unknown_scheme(scheme: str) -> UsageError:
    """Build the error for a URL that no engine opens."""
    return UsageError(
        f"scheme {scheme!r}: give a path, sqlite:///path or postgresql://host/database"
    )
