"""How kernels are compiled: the numba options of this package, here and nowhere else.

numba's on-disk cache watches only the file of the entry itself, by time stamp and size. A leaf
edited in another file, or a wheel whose files all carry one fixed time stamp, would leave stale
machine code behind. So the cache folder's name carries a digest of every source in this folder;
users' own kernels keep the folder that they configured.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import config

ENTRIES: list[Any] = []
"""Every compiled entry, in order of definition; what `warm_up` is checked against."""


def sources_digest(folder: Path) -> str:
    """Digest of the names and contents of the Python sources in `folder`, 16 hex digits."""
    digest = hashlib.sha256()
    for source in sorted(folder.glob("*.py")):
        content = source.read_bytes()
        digest.update(f"{source.name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()[:16]


def cache_folder() -> str:
    """Folder for this version's machine code: under NUMBA_CACHE_DIR or the user's cache."""
    root = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    base = Path(root) if root else Path.home() / ".cache"
    name = f"hapticdb/kernels-{sources_digest(Path(__file__).parent)}"
    for candidate in (base, Path(tempfile.gettempdir()) / f"hapticdb-{os.getuid()}"):
        folder = candidate / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return str(folder)
    return tempfile.mkdtemp(prefix="hapticdb-kernels-")


_CACHE_FOLDER = cache_folder()


def entry(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel that Python calls: cached on disk, without the interpreter lock."""
    before = config.CACHE_DIR
    config.CACHE_DIR = _CACHE_FOLDER
    try:
        compiled = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    finally:
        config.CACHE_DIR = before
    ENTRIES.append(compiled)
    return compiled  # type: ignore[no-any-return]


def leaf(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a scalar function that only kernels call; LLVM inlines it."""
    return numba.njit(nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a leaf that takes arrays: put into its caller by numba, with no counted reference."""
    decorate = numba.njit(nogil=True, error_model="numpy", inline="always")
    return decorate(function)  # type: ignore[no-any-return]
