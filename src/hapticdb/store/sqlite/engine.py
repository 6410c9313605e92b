"""SQLite as an engine: paths and ``sqlite:///path``, one file an environment."""

import re
from pathlib import Path

from hapticdb.errors import UsageError
from hapticdb.grid import Grid
from hapticdb.store.base import Layout, Progress, Store
from hapticdb.store.engines import BackupReport, unknown_scheme
from hapticdb.store.sqlite.store import SQLiteStore

PREFIX = "sqlite:///"
# libpq's other form of an address, and a URL without its slashes: either may hold a password
KEYWORDS = re.compile(r"^postgres(ql)?:|(^|\s)\w*password\s*=", re.IGNORECASE)


class _SQLiteEngine:
    """Environments in files."""

    title = "SQLite"

    def open(self, url: str, *, read_only: bool) -> Store:
        """Open an existing file."""
        return SQLiteStore.open(_path_of(url), read_only=read_only)

    def create(self, url: str, grid: Grid, layout: Layout, *, distances: bool = False) -> Store:
        """Make a new file, which appears whole or not at all."""
        return SQLiteStore.create(_path_of(url), grid, layout, distances=distances)

    def exists(self, url: str) -> bool:
        """Whether a file of that name is there."""
        return _path_of(url).exists()

    def beside(self, url: str, ending: str) -> str:
        """Path of another file in the same folder."""
        return str(_path_of(url).with_name(f"{_path_of(url).stem}{ending}.db"))

    def back_up(
        self, url: str, copy: str, *, replace: bool, progress: Progress | None
    ) -> BackupReport:
        """Copy a file whole, as of one moment."""
        from hapticdb.store.sqlite.backup import back_up  # noqa: PLC0415 - seldom needed

        return back_up(_path_of(url), _path_of(copy), replace=replace, progress=progress)

    def restore(self, copy: str, url: str, *, progress: Progress | None) -> BackupReport:
        """Put a copy in a file's place, and remove the log of the former file."""
        from hapticdb.store.sqlite.backup import back_up  # noqa: PLC0415 - seldom needed

        return back_up(_path_of(copy), _path_of(url), replace=True, progress=progress)


ENGINE = _SQLiteEngine()


def _path_of(url: str) -> Path:
    """Path of the file that a URL or a path means."""
    text = url
    if text.startswith(PREFIX):
        text = text.removeprefix(PREFIX)
    elif "://" in text:
        raise unknown_scheme(text.split("://", 1)[0])
    if KEYWORDS.search(text):  # not shown: it holds a password
        raise UsageError("libpq's keywords are not read here: give postgresql://user@host/database")
    if not text:
        raise UsageError("an empty path: name the environment's file")
    if text.startswith((":memory:", "file:")):
        raise UsageError(f"{text!r}: an environment is a file; give its path")
    return Path(text)
