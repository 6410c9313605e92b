"""A PostgreSQL server of our own in a folder: for the tests, and for a first try of the engine.

The folder holds ``data`` (PostgreSQL's own), ``socket``, ``log``, ``lock`` and ``users``. Only a
Unix socket leads to the server, in a folder that its owner alone may enter, so it asks for no
password. It runs until it is stopped, whatever becomes of the process that started it.
"""

import atexit
import contextlib
import fcntl
import hashlib
import os
import re
import shutil
import signal
import stat
import tempfile
import time
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import psycopg
from psycopg import sql

from hapticdb.errors import DatabaseError
from hapticdb.store.postgres.server_binaries import (
    Account,
    Binaries,
    account_for,
    find_binaries,
    fitting,
    hand_over,
    run,
)

__all__ = ["Binaries", "PrivateServer", "find_binaries", "shared_server"]

USER = "hapticdb"
"""The superuser of a private server."""
PORT = 5432
"""Number in the name of the socket. No network port is opened."""
OWN_NAMES = {"data", "data.new", "socket", "log", "lock", "users"}
SOCKET_BYTES = 107 - len(f"/.s.PGSQL.{PORT}")
"""Bytes of the longest path of a socket's folder."""
LOG_BYTES = 8 << 20
START_S = 600.0
"""Seconds that a start may take: recovery after a crash replays up to ``max_wal_size``."""
STOP_S = 120.0
ORPHANS_S = 10.0
"""Seconds for the children of a killed server to notice its end, and to end, too."""
PARTING_S = 0.5
"""Seconds for the server to notice that a client has closed its connection."""
POLL_S = 0.01


class PrivateServer:
    """A PostgreSQL server in a folder of its own. Find one, or set one up, with `at`.

    Any number of processes may share a folder: the first `start` starts the server, the others
    join it, and the last `release` stops it.
    """

    def __init__(
        self, folder: Path, binaries: Binaries | None, settings: Mapping[str, str]
    ) -> None:
        self.folder = folder
        self._data = folder / "data"
        self._settings = dict(settings)
        self._users: int | None = None
        with self._locked() as lock:
            self.binaries = fitting(self._data, binaries)
            self._account = account_for(folder, self.binaries)
            if not self._data.exists():
                self._set_up(lock)
            self._socket = self._socket_folder()

    @classmethod
    def at(
        cls,
        folder: str | os.PathLike[str],
        binaries: Binaries | None = None,
        settings: Mapping[str, str] | None = None,
    ) -> "PrivateServer":
        """Find the server in a folder, or set one up where the folder is new or empty.

        folder : for the server alone; made, with its parents, where it is missing. binaries : by
        default those that fit the folder, for a new one the first found. settings : PostgreSQL's
        for a start by this object; all others are those of ``data/postgresql.conf``.

        Raises `DatabaseError` if the folder holds something else, or data of a major version that
        is not found; if no PostgreSQL is found at all; if the folder cannot be set up.
        """
        where = Path(folder).expanduser().resolve()
        if not Path("/proc/self/stat").exists():
            raise DatabaseError("a private server needs Linux: install PostgreSQL, give its URL")
        try:
            where.mkdir(mode=0o700, parents=True, exist_ok=True)
            names = {path.name for path in where.iterdir()}
        except OSError as error:
            raise DatabaseError(f"{where} cannot hold a server: {error.strerror}") from error
        if names and not (names <= OWN_NAMES and "lock" in names):
            raise DatabaseError(f"{where} holds something else: give the server a new folder")
        return cls(where, binaries, settings or {})

    # -- its life ----------------------------------------------------------------------------

    def start(self) -> None:
        """Start the server, or join it where it runs; returns when it accepts connections.

        Raises `DatabaseError` if it does not; the message ends with the end of the server's log.
        """
        with self._locked():
            deadline = time.monotonic() + ORPHANS_S
            while (failure := self._try_start()) is not None:
                if "still in use" not in failure or time.monotonic() > deadline:
                    raise DatabaseError(f"the server in {self.folder} does not start: {failure}")
                time.sleep(10 * POLL_S)
            if self._users is None:
                self._users = self._open("users", os.O_RDWR)
                fcntl.flock(self._users, fcntl.LOCK_SH)

    def stop(self) -> None:
        """Stop the server, even if it is in use, and wait for its end; nothing if none runs."""
        with self._locked():
            self._leave()
            self._stop()

    def release(self) -> None:
        """Stop the server unless somebody else uses it.

        Others are objects of this class, in any process, that started or joined it and have not
        released it, and all open connections.
        """
        with self._locked():
            self._leave()
            if self.is_running and not self._is_used():
                self._stop()

    @property
    def is_running(self) -> bool:
        """Whether the server's process is there."""
        return self._postmaster() is not None

    # -- its databases -----------------------------------------------------------------------

    def conninfo(self, database: str = "postgres") -> str:
        """URL of a database of this server for libpq; the same after every start."""
        host = quote(os.fsencode(self._socket), safe="/")
        name = quote(database, safe="")
        return f"postgresql:///{name}?host={host}&port={PORT}&user={USER}"

    def create_database(self, name: str) -> None:
        """Make a database on the running server, unless it has one of that name."""
        with self._locked(), self._connected() as connection:
            asked = connection.execute("SELECT 1 FROM pg_database WHERE datname = %s", [name])
            if asked.fetchone() is None:
                named = sql.Identifier(name)
                connection.execute(sql.SQL("CREATE DATABASE {}").format(named))

    @contextlib.contextmanager
    def _connected(self) -> Iterator[psycopg.Connection[tuple[Any, ...]]]:
        try:
            with psycopg.connect(self.conninfo(), autocommit=True) as connection:
                yield connection
        except psycopg.Error as error:
            cause = " ".join(str(error).split())
            raise DatabaseError(f"the server in {self.folder}: {cause}") from error

    def _is_used(self) -> bool:
        """Whether another object of this class has joined, or another client is connected."""
        users = self._open("users", os.O_RDWR)
        try:
            fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(users)
        deadline = time.monotonic() + PARTING_S
        try:
            with self._connected() as connection:
                while time.monotonic() < deadline:
                    asked = connection.execute(
                        "SELECT count(*) FROM pg_stat_activity"
                        " WHERE backend_type = 'client backend' AND pid <> pg_backend_pid()"
                    )
                    if asked.fetchall() == [(0,)]:
                        return False
                    time.sleep(POLL_S)
        except DatabaseError:
            pass  # it refuses one connection more
        return True

    # -- its folder --------------------------------------------------------------------------

    def _open(self, name: str, flags: int) -> int:
        """Open a file of the folder for its owner; refuses a symbolic link."""
        try:
            opened = os.open(self.folder / name, flags | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            if os.geteuid() == 0:
                owner = self.folder.stat()
                os.fchown(opened, owner.st_uid, owner.st_gid)
        except OSError as error:
            raise DatabaseError(
                f"{self.folder / name} cannot be opened: {error.strerror}"
            ) from error
        return opened

    @contextlib.contextmanager
    def _locked(self) -> Iterator[int]:
        """Lets one process at a time set up, start and stop the server."""
        lock = self._open("lock", os.O_RDWR)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield lock
        finally:
            os.close(lock)

    def _leave(self) -> None:
        if self._users is not None:
            os.close(self._users)
            self._users = None

    def _set_up(self, lock: int) -> None:
        """Fill a folder beside `data` and rename it, so that a cut-off start leaves no `data`."""
        fresh = self.folder / "data.new"
        shutil.rmtree(fresh, ignore_errors=True)
        command = [self.binaries.path("initdb"), "-D", str(fresh), "-U", USER, "-A", "trust"]
        command += ["--encoding=UTF8", "--locale=C", "--data-checksums"]
        if self._settings.get("fsync") == "off":
            command.append("--no-sync")
        # initdb holds our lock, too: if we are killed, others wait until it has ended
        done = run(command, self._account, self.folder, kept=(lock,))
        if done.returncode != 0:
            cause = " ".join(done.stderr.split()) or f"initdb ends with {done.returncode}"
            raise DatabaseError(f"{self.folder} cannot hold a server: {cause}")
        fresh.rename(self._data)

    def _socket_folder(self) -> Path:
        """`socket` in the folder; if libpq cannot use that path, a link with a short path."""
        here = self.folder / "socket"
        if _is_address(here):
            if here.is_symlink():
                here.unlink()
            self._make_private(here)
            return here
        digest = hashlib.blake2s(os.fsencode(self.folder), digest_size=4).hexdigest()
        prefix = f"hapticdb-{digest}-"  # a copied or moved folder must not share the socket
        there = here.resolve()
        if not (here.is_symlink() and there.name.startswith(prefix) and there.is_dir()):
            there = Path(tempfile.mkdtemp(prefix=prefix)).resolve()
            if not _is_address(there):
                there.rmdir()
                raise DatabaseError(f"{there} is too long for a socket: set TMPDIR to a short path")
            hand_over([there], self._account)
            with contextlib.suppress(FileNotFoundError):
                here.unlink() if here.is_symlink() else shutil.rmtree(here)
            here.symlink_to(there)
        self._make_private(there)
        return there

    def _make_private(self, folder: Path) -> None:
        """Make a folder that only its owner may enter, or check that an existing one is such."""
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
            hand_over([folder], self._account)
        found = folder.lstat()
        owner = os.geteuid() if self._account.uid is None else self._account.uid
        if not stat.S_ISDIR(found.st_mode) or found.st_mode & 0o077 or found.st_uid != owner:
            raise DatabaseError(f"{folder} is open to others: remove it, or set its mode to 0700")

    # -- its process -------------------------------------------------------------------------

    def _postmaster(self) -> int | None:
        """Process id of the running server."""
        lines = self._pid_file()
        if not lines or not lines[0].isdecimal():
            return None
        # after a restart of the machine another process may have this number
        command = _command_of(int(lines[0]))
        is_ours = Path(command[0]).name == "postgres" and str(self._data) in command
        return int(lines[0]) if is_ours else None

    def _pid_file(self) -> list[str]:
        """Lines of postmaster.pid: the first is the process id, the last the server's state."""
        try:
            return (self._data / "postmaster.pid").read_text(errors="replace").splitlines()
        except FileNotFoundError:
            return []

    def _try_start(self) -> str | None:
        """Start the server unless it runs, and wait for it; returns the reason of a failure."""
        log = self._open("log", os.O_RDWR | os.O_APPEND)
        try:
            if os.fstat(log).st_size > LOG_BYTES:
                os.ftruncate(log, 0)
            before = os.fstat(log).st_size
            pid = self._postmaster() or self._launch(log)
            deadline = time.monotonic() + START_S
            while time.monotonic() < deadline:
                lines = self._pid_file()
                if lines and lines[0] == str(pid) and lines[-1].strip() in {"ready", "standby"}:
                    return None
                if _parent_of(pid) is None:
                    return _complaint(os.pread(log, LOG_BYTES, before).decode("utf-8", "replace"))
                time.sleep(POLL_S)
            return "it is still recovering, try again later"
        finally:
            os.close(log)

    def _launch(self, log: int) -> int:
        """Start the server's process without our terminal and our pipes; returns its id."""
        self._forget_stale()
        socket = str(self._socket).replace('"', '""')  # an element of a list, quoted
        settings = {
            **self._settings,
            "listen_addresses": "",
            "port": str(PORT),
            "unix_socket_directories": f'"{socket}"',
            "unix_socket_permissions": "0700",
        }
        command = [self.binaries.path("postgres"), "-D", str(self._data)]
        for name, value in settings.items():
            command += ["-c", f"{name}={value}"]
        # the shell ends at once, so the server is not our child and leaves us no zombie
        shell = ["/bin/sh", "-c", 'exec "$@" >&2 & echo $!', "sh", *self._account.prefix]
        account = Account(uid=self._account.uid, gid=self._account.gid)
        return int(run([*shell, *command], account, self.folder, errors=log).stdout)

    def _forget_stale(self) -> None:
        """Remove the pid files of a server that has ended, if its process id is still in use.

        Another process may have the id, or the ended process is a zombie. PostgreSQL itself removes
        the files when the id is free, but refuses to start while it is in use.
        """
        lines = self._pid_file()
        if not (lines and lines[0].isdecimal() and Path(f"/proc/{lines[0]}").exists()):
            return
        if not Path(_command_of(int(lines[0]))[0]).name.startswith("postgres"):
            (self._data / "postmaster.pid").unlink()
            (self._socket / f".s.PGSQL.{PORT}.lock").unlink(missing_ok=True)

    def _stop(self) -> None:
        pid = self._postmaster()
        if pid is not None:
            os.kill(pid, signal.SIGINT)
        deadline = time.monotonic() + STOP_S
        while pid is not None and _parent_of(pid) is not None:
            if time.monotonic() > deadline:
                raise DatabaseError(f"the server in {self.folder} does not end: see its log there")
            time.sleep(POLL_S)


@cache
def shared_server(folder: Path) -> PrivateServer:
    """The server in a folder, released when the process ends.

    Threads that ask at once may each get an object; the server ends with the last of them.
    """
    server = PrivateServer.at(folder)
    atexit.register(server.release)
    return server


def _is_address(folder: Path) -> bool:
    """Whether libpq can reach a socket in that folder: a comma in it would end the host's name."""
    return len(os.fsencode(folder)) <= SOCKET_BYTES and "," not in str(folder)


def _command_of(pid: int) -> list[str]:
    """Command line of a process, [""] without one."""
    try:
        line = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        line = b""
    return os.fsdecode(line).split("\0")


def _parent_of(pid: int) -> int | None:
    """Parent of a living process; None for a process that has ended, even for a zombie."""
    try:
        line = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return None
    state, parent = line.rpartition(")")[2].split()[:2]  # a name in parentheses holds anything
    return None if state in {"Z", "X"} else int(parent)


def _complaint(log: str) -> str:
    """Complaint at the end of a server's log, on one line."""
    lines = [re.sub(r"^\d{4}-.*?\] ", "", line) for line in log.splitlines() if line]
    told = [line for line in lines if not line.startswith("LOG:")] or lines
    return " ".join(" ".join(told[-4:]).split()) or "its log is empty"
