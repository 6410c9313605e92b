"""Cache folder of machine code and tools, shared by a user's processes; located without numba.

Permission to write into it, or to replace it or a folder above it, is permission to run code in
this process.
"""

import atexit
import hashlib
import os
import shutil
import stat
import tempfile
import warnings
from functools import cache
from pathlib import Path

LENT = "HAPTICDB_KERNELS"
"""Environment variable with the temporary folder of a process, for its child processes."""


def sources_digest(folder: Path) -> str:
    """Digest of the names and contents of the Python sources below `folder`, 16 hex digits."""
    digest = hashlib.sha256()
    for source in sorted(folder.rglob("*.py")):
        content = source.read_bytes()
        digest.update(f"{source.relative_to(folder)}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()[:16]


@cache
def cache_folder() -> Path:
    """Folder under NUMBA_CACHE_DIR or the user's cache, or else under that of temporary files.

    A folder writable or replaceable by other users is refused with a warning. The last resort is a
    temporary folder, removed at the end of this process.
    """
    lent = os.environ.get(LENT, "")
    if Path(lent).is_dir() and lent:
        return Path(lent)
    root = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    temporary = Path(tempfile.gettempdir(), f"hapticdb-{os.geteuid()}")
    for one in (Path(root or "~/.cache", "hapticdb"), temporary):
        try:
            folder = one.expanduser()
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            found = folder.resolve(strict=True)
            if (fault := _fault(found)) is not None:
                warnings.warn(
                    f"nothing is kept in {folder}: {fault}",
                    RuntimeWarning,
                    stacklevel=2,
                )
            elif os.access(found, os.W_OK):
                return found
        except (OSError, RuntimeError):  # nobody's home, or a loop of links
            continue
    own = os.environ[LENT] = tempfile.mkdtemp(prefix="hapticdb-")
    atexit.register(_remove, own, os.getpid())
    return Path(own)


def _fault(folder: Path) -> str | None:
    """Reason why other users could write into a folder or replace it, or None.

    Every folder above counts, up to the home directory or the root. The sticky bit, as of /tmp,
    protects entries from replacement by other users.
    """
    home = Path(os.path.expanduser("~")).resolve()  # noqa: PTH111 - no error without a home
    for each in (folder, *folder.parents):
        known = each.stat()
        if known.st_uid not in {0, os.geteuid()}:
            return f"{each} belongs to another user"
        is_shared = known.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        if is_shared and (each == folder or not known.st_mode & stat.S_ISVTX):
            return f"others can write into {each}"
        if each == home:
            break
    return None


def _remove(folder: str, pid: int) -> None:
    if os.getpid() == pid:  # not in a forked copy of the process
        shutil.rmtree(folder, ignore_errors=True)
