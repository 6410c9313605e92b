"""The folder in which machine code is kept between processes; found without loading numba.

numba's on-disk cache watches only the file of the entry itself, by time stamp and size. A leaf
edited in another file, or a wheel whose files all carry one fixed time stamp, would leave stale
machine code behind. So the cache folder's name carries a digest of every source below this folder.

Whoever can write into the folder has their code run by this process. So it must be a folder of this
user alone.
"""

import atexit
import hashlib
import os
import shutil
import stat
import tempfile
import warnings
from pathlib import Path

IN_WORKER = "HAPTICDB_COMPILING"
"""Environment variable that is set in a process that only compiles."""
LENT = "HAPTICDB_KERNELS"
"""Environment variable by which a process gives its own folder to the processes that it starts."""


def sources_digest(folder: Path) -> str:
    """Digest of the names and contents of the Python sources below `folder`, 16 hex digits."""
    digest = hashlib.sha256()
    for source in sorted(folder.rglob("*.py")):
        content = source.read_bytes()
        digest.update(f"{source.relative_to(folder)}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()[:16]


def cache_folder() -> str:
    """Folder for this version's machine code: under NUMBA_CACHE_DIR or the user's cache.

    If it cannot be made there, under the folder of temporary files. A folder that others could
    write into is not used, and a warning names it. The last resort is a folder that ends with this
    process.
    """
    name = f"kernels-{sources_digest(Path(__file__).parent)}"
    lent = os.environ.get(LENT, "")
    if name in lent and Path(lent).is_dir():
        return lent
    root = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    base = Path(root) if root else Path.home() / ".cache"
    for outer in (base / "hapticdb", Path(tempfile.gettempdir()) / f"hapticdb-{os.geteuid()}"):
        folder = outer / name
        try:
            outer.parent.mkdir(parents=True, exist_ok=True)
            if not (_made_private(outer) and _made_private(folder)):
                warnings.warn(
                    f"compiled kernels are not kept in {folder}: it is a link, another user's, or "
                    "others can write there",
                    RuntimeWarning,
                    stacklevel=2,
                )
            elif os.access(folder, os.W_OK):
                return str(folder)
        except OSError:
            continue
    own = os.environ[LENT] = tempfile.mkdtemp(prefix=f"hapticdb-{name}-")
    atexit.register(_remove, own, os.getpid())
    return own


def _made_private(folder: Path) -> bool:
    """Make a folder unless it is there; whether this user alone can write into it or replace it."""
    folder.mkdir(mode=0o700, exist_ok=True)
    found, around = folder.lstat(), folder.parent.stat()
    return (
        stat.S_ISDIR(found.st_mode)
        and found.st_uid == os.geteuid()
        and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        and (not around.st_mode & stat.S_IWOTH or bool(around.st_mode & stat.S_ISVTX))
    )


def _remove(folder: str, pid: int) -> None:
    if os.getpid() == pid:  # not in a forked copy of the process
        shutil.rmtree(folder, ignore_errors=True)


CACHE_FOLDER = cache_folder()
"""Folder in which this process keeps and finds machine code."""
