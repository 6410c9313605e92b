"""The folder in which machine code is kept between processes; found without loading numba.

numba's on-disk cache watches only the file of the entry itself, by time stamp and size. A leaf
edited in another file, or a wheel whose files all carry one fixed time stamp, would leave stale
machine code behind. So the cache folder's name carries a digest of every source below this folder.
"""

import hashlib
import os
import tempfile
from pathlib import Path

IN_WORKER = "HAPTICDB_COMPILING"
"""Environment variable that is set in a process that only compiles."""


def sources_digest(folder: Path) -> str:
    """Digest of the names and contents of the Python sources below `folder`, 16 hex digits."""
    digest = hashlib.sha256()
    for source in sorted(folder.rglob("*.py")):
        content = source.read_bytes()
        digest.update(f"{source.relative_to(folder)}\0{len(content)}\0".encode())
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


CACHE_FOLDER = cache_folder()
"""Folder in which this process keeps and finds machine code."""
