"""Opening and creating SQLite files; SQLite's errors as errors of `hapticdb.errors`."""

import contextlib
import glob
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import apsw

from hapticdb.errors import (
    BusyError,
    DamagedError,
    DatabaseError,
    EnvironmentExistsError,
    EnvironmentNotFoundError,
    NotAnEnvironmentError,
    ReadOnlyError,
)
from hapticdb.kernels.records.rows import DECODED_BYTES
from hapticdb.store.sqlite import raw as sqlite_bytes
from hapticdb.store.sqlite.opened_file import OpenedFile
from hapticdb.store.store_errors import check_format, made_before

APPLICATION_ID = int.from_bytes(b"hapt")
"""Application id in the header of each file, set by `schema.sql`."""
BEFORE_FORMAT_1 = int.from_bytes(b"HAPT")
"""Application id before 0.1."""
SCHEMA = Path(__file__).with_name("schema.sql")
BUSY_TIMEOUT_MS = 10_000
"""Milliseconds of a write's wait for another process's write, before BusyError."""
CACHE_KIB = 256 * 1024 - DECODED_BYTES // 1024
"""KiB of a connection's page cache, filled by reads: with decoded bricks, enough for a large car.
"""
SHARED_BYTES = 32 << 10
"""Bytes of the file -shm, required by each connection in WAL mode."""
MOUNTS = Path("/proc/self/mountinfo")
NETWORKS = {"nfs", "nfs4", "cifs", "smb3"}
"""File systems without memory shared between machines, which the index of a log needs."""
HEADER_BYTES = 100
MAGIC = b"SQLite format 3\0"


@contextlib.contextmanager
def named_errors(path: str) -> Iterator[None]:
    """Raise SQLite's errors as hapticdb's, with cause, path and remedy."""
    try:
        yield
    except (apsw.CorruptError, apsw.NotADBError, apsw.FormatError, UnicodeDecodeError) as error:
        raise damaged(path, str(error)) from error
    except (apsw.ReadOnlyError, apsw.PermissionsError) as error:
        raise ReadOnlyError(
            f"{path} can only be read: 'hapticdb backup {path} COPY' makes one to write to "
            f"({error})"
        ) from error
    except (apsw.BusyError, apsw.LockedError) as error:
        raise BusyError(f"{path} is being written by another process: try again later") from error
    except (apsw.FullError, apsw.IOError) as error:
        if isinstance(error, apsw.FullError) or _is_full(path):
            raise DatabaseError(f"{path}: the disk is full; what was committed is safe") from error
        raise DatabaseError(
            f"{path} cannot be read or written: look at the disk, at quotas and at limits of file "
            "sizes (ulimit -f); what was committed is safe"
        ) from error
    except (apsw.ConnectionClosedError, apsw.CursorClosedError) as error:
        raise DatabaseError(f"{path} has been closed: open it again") from error
    except apsw.CantOpenError as error:
        raise DatabaseError(f"{path} cannot be opened: check its folder's rights") from error
    except (apsw.SQLError, apsw.MismatchError, apsw.ConstraintError) as error:
        # the statements fit an environment's tables, so these are other tables
        raise damaged(path, str(error)) from error


def _is_full(path: str) -> bool:
    """Whether no file can grow in this folder, such as the -shm of a readable database."""
    with contextlib.suppress(OSError):
        return shutil.disk_usage(Path(path).parent).free < SHARED_BYTES
    return False


def damaged(path: str, cause: str) -> DamagedError:
    """Build the error for an environment with broken contents."""
    return DamagedError(
        f"{path} is damaged ({cause}): 'hapticdb backup COPY {path} --replace' puts a copy in its "
        "place; or import the files again"
    )


def _check_kind(path: Path) -> None:
    """Refuse a missing file, a folder, a file of another kind, a truncated file.

    Reads the header of 100 bytes (https://sqlite.org/fileformat2.html, section 1.3) before SQLite
    opens the file, so a foreign file is never touched.
    """
    try:
        is_there = path.exists()
    except OSError as error:
        raise DatabaseError(f"{path} cannot be reached: {error.strerror}") from error
    if not is_there:
        raise EnvironmentNotFoundError(
            f"no environment at {path}; make one with 'hapticdb import {path} FILE'"
        )
    if not path.is_file():
        raise NotAnEnvironmentError(f"{path} is not a file, so it is no environment")
    try:
        header = sqlite_bytes.read_bytes(path, HEADER_BYTES)
    except OSError as error:
        raise DatabaseError(f"{path} cannot be read: {error.strerror}") from error
    if not header:
        raise NotAnEnvironmentError(f"{path} is empty; remove it, or give another path")
    if header[:16] != MAGIC[: len(header[:16])]:
        raise _foreign(path)
    if len(header) < HEADER_BYTES:
        raise damaged(str(path), "its header is cut off")
    mark = application_id(header)
    if mark == BEFORE_FORMAT_1:
        raise made_before(str(path))
    if mark != APPLICATION_ID:
        raise _foreign(path)
    check_format(str(path), int.from_bytes(header[60:64]))
    wal = Path(f"{path.resolve()}-wal")
    if wal.exists() and wal.stat().st_size:
        return  # the size in the header may be older than the log: SQLite decides
    # 1 stands for 65536, which has no room in two bytes
    page = int.from_bytes(header[16:18], "big")
    expected = int.from_bytes(header[28:32], "big") * (65536 if page == 1 else page)
    if path.stat().st_size < expected:
        raise damaged(str(path), f"{path.stat().st_size} bytes of {expected}")


def application_id(header: bytes) -> int:
    """Application id of a file's header."""
    return int.from_bytes(header[68:72])


def open_file(path: Path, *, read_only: bool) -> tuple[apsw.Connection, OpenedFile]:
    """Open an existing environment."""
    _check_kind(path)
    file = OpenedFile(path)
    # decided before SQLite opens the file, which may create the -shm itself
    is_immutable = read_only and needs_immutable(path)
    with named_errors(str(path)):
        connection = _connect_to_read(path) if read_only else _connect_to_write(path)
        try:
            connection.execute("SELECT id FROM environment").fetchall()  # the first read
            file.settle(is_immutable=is_immutable)
        except BaseException:
            connection.close()
            raise
    return connection, file


def create_file(path: Path, fill: Callable[[apsw.Connection], None]) -> None:
    """Make an environment, whole or not at all; `fill` writes its first rows."""
    check_free(path)
    check_folder(path)
    if network := network_of(path):
        raise ReadOnlyError(f"{_on_network(path, network)}, or in PostgreSQL")
    with unfinished_beside(path) as unfinished:
        made = apsw.Connection(str(unfinished))
        with named_errors(str(path)), contextlib.closing(made) as new:
            new.execute(f"PRAGMA page_size = {sqlite_bytes.PAGE_BYTES}")
            # no journal: nobody sees the file before it is whole, and a failure removes it
            new.execute("PRAGMA journal_mode = OFF").fetchall()
            new.execute(SCHEMA.read_text(encoding="utf-8"))
            fill(new)
            new.execute("PRAGMA journal_mode = WAL").fetchall()
        # after the close: a link to a file with an open log would miss its last pages
        publish(unfinished, path)


def check_free(path: Path) -> None:
    """Refuse the path of an existing file, or of a deleted file's log."""
    if path.exists():
        raise EnvironmentExistsError(f"{path} exists already; open it, or give another path")
    log = Path(f"{path}-wal")
    if log.exists() and log.stat().st_size:
        raise EnvironmentExistsError(
            f"{log} was left by a {path.name} that is gone: put that file back, or remove "
            f"{log.name} and {path.name}-shm"
        )


def check_folder(path: Path) -> None:
    """Refuse a path without a writable folder."""
    if not path.parent.is_dir():
        raise EnvironmentNotFoundError(f"folder {path.parent} does not exist; make it first")
    if not os.access(path.parent, os.W_OK):
        raise ReadOnlyError(f"folder {path.parent} cannot be written to; give another path")


@contextlib.contextmanager
def unfinished_beside(path: Path) -> Iterator[Path]:
    """Path of a temporary file for `path`, removed at the end unless it was moved."""
    _sweep_unfinished(path)
    # in the same folder: a link cannot cross file systems
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        yield unfinished
    finally:
        for suffix in ("", "-wal", "-shm", "-journal"):
            Path(f"{unfinished}{suffix}").unlink(missing_ok=True)


def publish(unfinished: Path, path: Path) -> None:
    """Link a finished file to its path, unless the path exists."""
    try:
        os.link(unfinished, path)  # unlike a rename, a link never replaces another file
    except FileExistsError as error:
        raise EnvironmentExistsError(f"{path} exists already; open it") from error
    except OSError:
        unfinished.rename(path)  # a file system without hard links


def remove_file(path: Path) -> None:
    """Delete a database with its -wal and -shm."""
    for suffix in ("", "-wal", "-shm"):
        Path(f"{path}{suffix}").unlink(missing_ok=True)


def _sweep_unfinished(path: Path) -> None:
    """Remove the temporary files of killed processes for this path."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.new*"):
        pid = left.name.split(".")[-2]
        # a live process may be in the middle of its own import
        if pid.isdigit() and not Path(f"/proc/{pid}").exists():
            left.unlink(missing_ok=True)


def network_of(path: Path) -> str | None:
    """Type of the network file system of a file's folder, None on a local one."""
    device = path.resolve().parent.stat().st_dev
    with contextlib.suppress(OSError):  # not Linux
        for line in MOUNTS.read_text().splitlines():
            mount, _, kind = line.partition(" - ")
            if mount.split()[2] == f"{os.major(device)}:{os.minor(device)}":
                found = kind.split()[0]
                return found if found in NETWORKS else None
    return None


def needs_immutable(path: Path) -> bool:
    """Whether this file can only be opened as immutable.

    A database in WAL mode needs its ``-shm`` in the same folder. Without the right to create it, or
    on a network file system, SQLite can still read the file alone, if there is no log.
    """
    real, network = path.resolve(), network_of(path)
    if not network and (os.access(real.parent, os.W_OK) or Path(f"{real}-shm").exists()):
        return False
    log = Path(f"{real}-wal")
    if log.exists() and log.stat().st_size:
        why = f"are on a network file system ({network})" if network else "cannot be written here"
        raise ReadOnlyError(
            f"{log} holds changes that are not in {path.name} yet, and both {why}: copy both files "
            "into a folder on a local disk that can be written"
        )
    return True


def _on_network(path: Path, network: str) -> str:
    return (
        f"{path} is on a network file system ({network}), where SQLite's log is not safe: write to "
        "an environment on a local disk"
    )


def _connect_to_read(path: Path) -> apsw.Connection:
    options = "?immutable=1" if needs_immutable(path) else "?mode=ro"
    connection = apsw.Connection(
        path.resolve().as_uri() + options,
        flags=apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI | apsw.SQLITE_OPEN_NOMUTEX,
    )
    _settle(connection)
    return connection


def _connect_to_write(path: Path) -> apsw.Connection:
    if not (os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)):
        needs_immutable(path)  # raises if a backup could not be made
        raise ReadOnlyError(
            f"{path} can only be read: 'hapticdb backup {path} COPY' makes one to write to"
        )
    if network := network_of(path):
        backup = f"'hapticdb backup {path} COPY' makes one there"
        raise ReadOnlyError(f"{_on_network(path, network)}: {backup}; it can be read here")
    flags = apsw.SQLITE_OPEN_READWRITE | apsw.SQLITE_OPEN_NOMUTEX
    connection = apsw.Connection(str(path), flags=flags)
    _settle(connection)
    # the statement journal of many rows contains the changed pages: 65 of 164 MB of a write
    connection.execute("PRAGMA temp_store = MEMORY")
    return connection


def _settle(connection: apsw.Connection) -> None:
    connection.set_busy_timeout(BUSY_TIMEOUT_MS)
    connection.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
    # in WAL mode NORMAL survives the death of the process; only a power cut can lose the last
    # commits, and even then the database stays valid
    connection.execute("PRAGMA synchronous = NORMAL")
    # never read a blob as text, nor a string in double quotes as a literal
    connection.config(apsw.SQLITE_DBCONFIG_DQS_DML, 0)
    connection.config(apsw.SQLITE_DBCONFIG_DQS_DDL, 0)


def _foreign(path: Path) -> NotAnEnvironmentError:
    return NotAnEnvironmentError(f"{path} is no hapticdb environment; give another path")
