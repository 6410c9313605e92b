"""Which PostgreSQL a private server runs, and under which account when root starts it."""

import importlib.util
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from hapticdb.errors import DatabaseError
from hapticdb.store.postgres import server_binaries
from hapticdb.store.postgres.private_server import Binaries, PrivateServer, find_binaries

FOUND = find_binaries()
assert FOUND, "no PostgreSQL found: install the extra postgres"
UNSAFE = {"fsync": "off"}


def test_without_any_postgresql_the_error_says_where_to_get_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_binaries, "SYSTEM_FOLDERS", ())
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    with pytest.raises(DatabaseError, match=r"pip install 'hapticdb\[postgres\]'"):
        PrivateServer.at(tmp_path / "server")


# --- root ---------------------------------------------------------------------------------------

root_only = pytest.mark.skipif(os.geteuid() != 0, reason="changing the account is root's to do")


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder that every account may enter; servers below the folder end with the test."""
    folder = Path(tempfile.mkdtemp(prefix="place-")).resolve()
    folder.chmod(0o755)
    yield folder
    for pid_file in folder.rglob("postmaster.pid"):
        PrivateServer.at(pid_file.parent.parent).kill()
    for socket in folder.rglob("socket"):
        shutil.rmtree(socket.resolve())
    shutil.rmtree(folder)


@pytest.fixture(params=FOUND, ids=lambda binaries: f"postgres{binaries.major}")
def binaries(request: pytest.FixtureRequest) -> Binaries:
    """Programs that every account may run; others are skipped."""
    assert isinstance(request.param, Binaries)
    account = server_binaries.Account(uid=65534, gid=65534)
    try:
        server_binaries.run([request.param.path("postgres"), "--version"], account)
    except PermissionError:
        pytest.skip("these programs are in a folder that is closed to other accounts")
    return request.param


def owner_of(server: PrivateServer) -> int:
    """User id of the server's process, from /proc."""
    return Path(f"/proc/{server._postmaster()}").stat().st_uid


def answers(server: PrivateServer) -> bool:
    with psycopg.connect(server.conninfo()) as connection:
        return connection.execute("SELECT 1").fetchone() == (1,)


@root_only
def test_root_keeps_the_folder_where_unshare_is_allowed(place: Path, binaries: Binaries) -> None:
    account = server_binaries.account_for(place, binaries)
    if account.prefix:
        server = PrivateServer.at(place / "server", binaries, UNSAFE)
        server.start()
        assert owner_of(server) == 0
    else:
        assert account.uid


@pytest.mark.long
@root_only
@pytest.mark.parametrize("unshare", ["false", "no-such-program"])
def test_where_unshare_is_not_allowed_an_account_gets_the_folder(
    place: Path, binaries: Binaries, monkeypatch: pytest.MonkeyPatch, unshare: str
) -> None:
    """A folder made with unshare goes to an account, which then runs the server for good."""
    folder = place / "server"
    PrivateServer.at(folder, binaries, UNSAFE)
    monkeypatch.setattr(server_binaries, "UNSHARE", (unshare,))
    server = PrivateServer.at(folder)
    server.start()
    owner = owner_of(server)
    assert owner != 0
    assert {path.lstat().st_uid for path in [folder, *folder.rglob("*")]} == {owner}
    server.stop()
    monkeypatch.undo()
    again = PrivateServer.at(folder)
    again.start()
    assert owner_of(again) == owner
    assert answers(again)


@root_only
def test_a_folder_that_the_account_cannot_enter_is_refused(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_binaries, "UNSHARE", ("false",))
    place.chmod(0o700)
    with pytest.raises(DatabaseError, match="choose places that everybody may enter"):
        PrivateServer.at(place / "server")
