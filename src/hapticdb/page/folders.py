"""Where objects' files may be read: below the folders that the operator names, nowhere else.

An object's link is text in the database. Whoever may write there could make the server read any
file of its machine and show it, so each path is checked before the file is opened.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from hapticdb.environment import Environment
from hapticdb.errors import FileError, UsageError
from hapticdb.ingest.originals import shell_of_objects
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object, Store


class AllowedFolders:
    """Folders below which files may be read; a UsageError if one is not there."""

    def __init__(self, folders: Sequence[str | Path]) -> None:
        self._folders = tuple(_resolved(Path(folder)) for folder in folders)

    @classmethod
    def of_links(cls, links: Iterable[str]) -> "AllowedFolders":
        """Allow the folders of the files that objects link to now; later links add none.

        A folder that is not there, or that this process may not enter, adds none either.
        """
        allowed = cls(())
        allowed._folders = tuple(sorted(_folders_of(links)))
        return allowed

    def checked(self, link: str) -> Path:
        """Return the file behind a link, as a path without symbolic links; to be opened as it is.

        FileError if the file does not exist, is no plain file, or lies outside the folders, also by
        a symbolic link. The message names no folder of this machine.
        """
        try:
            path = Path(link).resolve(strict=True)
            is_file = path.is_file()
        except (OSError, RuntimeError, ValueError):
            raise FileError("the object's file is not there") from None
        if not any(path.is_relative_to(folder) for folder in self._folders):
            raise FileError(
                "the object's file is outside the folders that may be read; the operator names "
                "them with --files"
            )
        if not is_file:
            raise FileError("the object's file is not a plain file")
        return path


class FoldersEnvironment(Environment):
    """An environment that reads objects' files below some folders only, else raises `FileError`."""

    def __init__(self, store: Store, folders: AllowedFolders) -> None:
        super().__init__(store)
        self._allowed = folders

    def shell(
        self,
        *words: int | str,
        points: int | None = None,
        spacing: float | None = None,
        seed: int = 0,
        inset: float = 0.0,
    ) -> PointShell:
        """Make a tool of objects; each file is opened by the path that was checked."""
        found = [
            replace(obj, link=str(self._allowed.checked(obj.link))) for obj in self.find(*words)
        ]
        return shell_of_objects(found, points, spacing, seed, inset)

    def restore(self, removed: Object) -> Object:
        """Put a removed object back."""
        self._allowed.checked(removed.link)
        return super().restore(removed)

    def move(self, object_id: int, transform: ArrayLike, *, revision: int | None = None) -> Object:
        """Move an object to a new placement."""
        self._allowed.checked(self.object(object_id).link)
        return super().move(object_id, transform, revision=revision)


def _folders_of(links: Iterable[str]) -> set[Path]:
    """Folders of files, without symbolic links, as far as they are there."""
    found = set()
    for parent in {Path(link).parent for link in links if link}:
        try:
            folder = parent.resolve(strict=True)
            if folder.is_dir():
                found.add(folder)
        except (OSError, RuntimeError, ValueError):
            continue
    return found


def _resolved(folder: Path) -> Path:
    try:
        found = folder.resolve(strict=True)
        is_folder = found.is_dir()
    except (OSError, RuntimeError):
        raise UsageError(f"--files {folder}: no such folder, or it may not be entered") from None
    if not is_folder:
        raise UsageError(f"--files {folder}: not a folder")
    return found
