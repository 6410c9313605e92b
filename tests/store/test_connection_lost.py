"""A connection that is lost at any moment loses no frame and no write, and repeats no write."""

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psycopg
import pytest

import hapticdb
from assemblies import placement
from children import TIMEOUT, child, descendants, joined, until
from command_line import command, tool
from crashes import EDITS, N_PARTS, PLACE, After, felt, small
from hapticdb import Environment, PointShell
from hapticdb.errors import ConnectionLostError, StuckError
from hapticdb.paper.strategies import STRATEGIES, Strategy
from hapticdb.store.postgres.connecting import link
from hapticdb.store.postgres.connecting.server_connection import ServerConnection
from postgres_servers import Server
from servers import Place
from validity import Contents, assert_valid, contents


class Proxy:
    """A socket between client and server that cuts the connection at a COMMIT.

    forwarded : the server gets the COMMIT, its answer is lost; not forwarded : the server gets no
    COMMIT; late : the server gets the COMMIT long after the client was cut off.
    """

    def __init__(self, server: Server, folder: Path) -> None:
        self._target = str(server.folder / ".s.PGSQL.5432")
        self.url = f"postgresql:///postgres?host={folder}&port=5432&user=hapticdb"
        self.cut: str | None = None
        self.n_cuts = 0
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(folder / ".s.PGSQL.5432"))
        self._listener.listen()
        self._accepting = threading.Thread(target=self._accept, daemon=True)
        self._accepting.start()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)  # `close` alone would not wake `_accept`
        joined(self._accepting)
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            upstream = socket.socket(socket.AF_UNIX)
            upstream.connect(self._target)
            threading.Thread(target=self._up, args=(client, upstream), daemon=True).start()
            threading.Thread(target=self._pass_on, args=(upstream, client), daemon=True).start()

    def _up(self, client: socket.socket, upstream: socket.socket) -> None:
        try:
            while block := client.recv(1 << 16):
                if b"COMMIT\0" in block and self.cut is not None:
                    self._cut(client, upstream, block)
                    return
                upstream.sendall(block)
        except OSError:
            pass
        with contextlib.suppress(OSError):
            upstream.shutdown(socket.SHUT_RDWR)

    def _cut(self, client: socket.socket, upstream: socket.socket, block: bytes) -> None:
        how, self.cut = self.cut, None
        self.n_cuts += 1
        client.shutdown(socket.SHUT_RDWR)
        if how == "late":
            time.sleep(0.3)
        if how != "not forwarded":
            upstream.sendall(block)
            time.sleep(0.05)
        with contextlib.suppress(OSError):
            upstream.shutdown(socket.SHUT_RDWR)

    def _pass_on(self, upstream: socket.socket, client: socket.socket) -> None:
        try:
            while block := upstream.recv(1 << 16):
                client.sendall(block)
        except OSError:
            pass
        client.close()


@pytest.mark.long
@pytest.mark.parametrize("how", ["forwarded", "not forwarded", "late"])
def test_commit_unanswered_counts_once(
    server: Server, file: Path, edited: list[Contents], how: str
) -> None:
    proxy = Proxy(server, server.folder.parent)
    with small(proxy.url, file) as env:
        for (_, edit), after in zip(EDITS, edited, strict=True):
            proxy.cut = how
            edit(env)
            assert contents(env) == after
        obj = env.object(3)
        rows = env.store.rows_of(3, *(np.array([key]) for key in (0, 2**62)))
        (surface,) = env.store.surfaces([obj.digest]).values()
        env.remove(3)
        proxy.cut = how
        assert env.store.add(obj, rows, surface) == 3
        # conditional on a revision: a repeated move would raise a conflict
        proxy.cut = how
        env.move(3, placement(0.01, 0, 0), revision=env.object(3).revision)
        assert_valid(env)
        assert env.store.revision() == N_PARTS + 5
    assert proxy.n_cuts == 4
    proxy.close()


def test_commit_other_write_of_same_revision(
    server: Server, url: str, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Our write is lost at its COMMIT; before we reconnect, another writer moves the object."""
    proxy = Proxy(server, server.folder.parent)
    with small(url, file) as other, hapticdb.open(proxy.url) as env:
        reconnect = ServerConnection._reconnect

        def late(here: ServerConnection) -> None:
            if here is env.store._connection:  # type: ignore[attr-defined]
                other.move(7, PLACE)
            reconnect(here)

        proxy.cut = "not forwarded"
        with monkeypatch.context() as patch:
            patch.setattr(ServerConnection, "_reconnect", late)
            env.move(7, placement(-0.05, 0, 0))
        np.testing.assert_array_equal(env.object(7).transform, placement(-0.05, 0, 0))
        assert_valid(env)
        assert env.store.revision() == N_PARTS + 2
    proxy.close()


def test_write_hanging_server_ends_and_repeats(
    server: Server, url: str, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server and its children are stopped: the connection stays, and nothing answers."""
    with small(url, file) as env:
        family = [server.pid, *descendants(server.pid)]
        try:
            for member in family:
                os.kill(member, signal.SIGSTOP)
            with monkeypatch.context() as patch:
                patch.setattr(link, "SILENCE_S", 0.3)
                patch.setattr(link, "ANSWER_S", 1.0)
                with pytest.raises(StuckError, match="did not answer a new client") as told:
                    env.move(7, PLACE)
        finally:
            for member in family:
                os.kill(member, signal.SIGCONT)
        assert "\n" not in str(told.value)
        env.move(7, PLACE)
        np.testing.assert_array_equal(env.object(7).transform, PLACE)
        assert_valid(env)


@pytest.mark.parametrize("is_killed", [False, True], ids=["hung", "ended"])
def test_watch_prompt_reports_lost_server(
    server: Server, url: str, file: Path, *, is_killed: bool
) -> None:
    with small(url, file) as env, hapticdb.open(env.url, read_only=True) as reading:
        reading.store.watch(is_prompt=True)
        pid = reading.store._connection.driver.info.backend_pid  # type: ignore[attr-defined]
        family = [pid] if is_killed else [server.pid, *descendants(server.pid)]
        try:
            for member in family:
                os.kill(member, signal.SIGTERM if is_killed else signal.SIGSTOP)
            error = ConnectionLostError if is_killed else StuckError
            words = "went away" if is_killed else "did not answer a new client within 0.15 s"
            with pytest.raises(error, match=words):
                until(lambda: reading.store.revision() < 0)
        finally:
            for member in family if not is_killed else ():
                os.kill(member, signal.SIGCONT)
        with hapticdb.open(env.url, read_only=True) as again:
            assert again.store.revision() == reading.store.revision()  # connects again


@pytest.fixture
def cut_off(admin: psycopg.Connection) -> Callable[[Environment], None]:
    """End the server process of an environment's connection, and wait until it is gone."""

    def end(env: Environment) -> None:
        pid = env.store._connection.driver.info.backend_pid  # type: ignore[attr-defined]
        admin.execute("SELECT pg_terminate_backend(%s, 5000)", (pid,))

    return end


CutOff = Callable[[Environment], None]


def test_reconnect_between_frames(
    place: Place, file: Path, sphere: PointShell, cut_off: CutOff
) -> None:
    with small(place(), file) as env:
        for strategy in STRATEGIES:
            expected = felt(env, sphere, np.eye(4), strategy)
            cut_off(env)
            assert felt(env, sphere, np.eye(4), strategy) == expected
        for ask in (env.objects, env.size, lambda: env.voxels(2), env.quantiles, env.calibrate):
            cut_off(env)
            assert ask() is not None
        for edit in (lambda: env.move(7, PLACE), lambda: env.remove(8), lambda: env.add(file)):
            cut_off(env)
            edit()
        assert_valid(env)
        assert len(env.objects()) == N_PARTS


@pytest.mark.parametrize("strategy", ["points", "statement"])
def test_reconnect_inside_frame(
    place: Place,
    file: Path,
    sphere: PointShell,
    cut_off: CutOff,
    strategy: Strategy,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with small(place(), file) as env:
        expected = felt(env, sphere, np.eye(4), strategy)
        for n_statements in (1, 2):
            with monkeypatch.context() as patch:
                After(patch, ServerConnection, "fetch", lambda: cut_off(env), n_statements)
                assert felt(env, sphere, np.eye(4), strategy) == expected


def test_snapshot_lost_connection_ends_it(place: Place, file: Path, cut_off: CutOff) -> None:
    """Reads before the loss were on the lost connection, perhaps at another revision."""
    with small(place(), file) as env:
        with env.store.snapshot():
            env.objects()
            cut_off(env)
            for _ in range(2):
                with pytest.raises(hapticdb.errors.ConnectionLostError, match="run the same again"):
                    env.objects()
        assert len(env.objects()) == N_PARTS
        with env.store.snapshot():  # everything was read before the connection was lost
            found = env.objects()
            cut_off(env)
        assert len(found) == len(env.objects()) == N_PARTS


def test_touch_interrupted_leaves_no_backend(
    place: Place, file: Path, tmp_path: Path, admin: psycopg.Connection
) -> None:
    where = place()
    small(where, file).close()
    many = tmp_path / "path.csv"
    many.write_text("x,y,z,qw,qx,qy,qz\n" + "0,0,0,1,0,0,0\n" * 5_000)
    stl = tool(tmp_path / "tool.stl")
    with child(command("touch", where, "--tool", stl, "--poses", many, "--json")) as touching:
        assert touching.stdout is not None
        for _ in range(5):
            touching.stdout.readline()
        touching.send_signal(signal.SIGINT)
        _, err = touching.communicate(timeout=TIMEOUT)
    assert touching.returncode == 130, err
    assert err == "hapticdb: interrupted\n"
    left = (
        "SELECT 1 FROM pg_stat_activity WHERE application_name = 'hapticdb'"
        " AND datname = current_database() AND query LIKE '%brick%'"
    )
    until(lambda: not admin.execute(left).fetchall())
