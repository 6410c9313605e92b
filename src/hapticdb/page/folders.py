"""Where objects' files may be read: below the folders that the operator names, nowhere else.

An object's link is text in the database. Whoever may write there could make the server read any
file of its machine and show it, so each path is checked before the file is opened.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

from hapticdb.errors import FileError, UsageError


class AllowedFolders:
    """Folders below which files may be read.

    Parameters
    ----------
    folders : sequence of str
        Each must exist.

    Raises
    ------
    UsageError
        If a folder is not there.
    """

    def __init__(self, folders: Sequence[str | Path]) -> None:
        self._folders = tuple(_resolved(Path(folder)) for folder in folders)

    @classmethod
    def of_links(cls, links: Iterable[str]) -> "AllowedFolders":
        """Allow the folders of the files that objects link to now; later links add none."""
        parents = {Path(link).parent for link in links if link}
        return cls(sorted(parent for parent in parents if parent.is_dir()))

    def checked(self, link: str) -> Path:
        """Return the file behind a link, as a path without symbolic links; to be opened as it is.

        Raises
        ------
        FileError
            If the file does not exist, is no plain file, or lies outside the folders, also by a
            symbolic link. The message names no folder of this machine.
        """
        try:
            path = Path(link).resolve(strict=True)
        except (OSError, RuntimeError, ValueError):
            raise FileError("the object's file is not there") from None
        if not any(path.is_relative_to(folder) for folder in self._folders):
            raise FileError(
                "the object's file is outside the folders that may be read; the operator names "
                "them with --files"
            )
        if not path.is_file():
            raise FileError("the object's file is not a plain file")
        return path


def _resolved(folder: Path) -> Path:
    try:
        found = folder.resolve(strict=True)
    except (OSError, RuntimeError):
        raise UsageError(f"--files {folder}: no such folder") from None
    if not found.is_dir():
        raise UsageError(f"--files {folder}: not a folder")
    return found
