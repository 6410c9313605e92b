"""Servers that freeze, vanish, come back, or never answer: what the hand feels then."""

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from children import PATIENCE, descendants, joined, named, until
from contact_hands import (
    DEPTH,
    STILL,
    Served,
    ended,
    falls_to_zero,
    lasting_port,
    pressed,
    serving,
    started,
)
from hapticdb.client import contact_connection, contact_proxy
from hapticdb.client.contact_proxy import ContactProxy
from hapticdb.errors import ConnectionLostError, ProtocolError, UsageError
from hapticdb.protocol.contacts import ProxyTerms, pack_terms

TERMS = ProxyTerms("a", (0.0, 0.0, 0.0), 0.01, 1000.0, 0.1, 7.0, 0.07, 5e4, 0.005, 0.0075, 0.01)


@pytest.fixture
def mortal(tmp_path: Path) -> Iterator[Served]:
    """A server that the test may freeze or kill."""
    with serving(tmp_path, port=lasting_port()) as server:
        yield server


@pytest.mark.parametrize("how", [signal.SIGSTOP, signal.SIGKILL])
def test_the_force_falls_to_zero_when_the_server_stops(mortal: Served, how: int) -> None:
    with ContactProxy(mortal.url()) as proxy:
        full = pressed(mortal, proxy)[2]
        os.kill(mortal.process.pid, how)
        felt = falls_to_zero(mortal, proxy)
        assert max(felt) <= 1.1 * full
        assert not proxy.told.is_fresh
        for _ in range(20):
            assert not proxy.wrench(mortal.pose(DEPTH), STILL).any()
            time.sleep(1e-3)


def test_the_process_that_fetches_is_started_again(mortal: Served) -> None:
    def fetching() -> set[int]:
        found = descendants(mortal.process.pid)
        return {pid for pid in found if named(pid) == "hdb-fetching"}

    with ContactProxy(mortal.url()) as proxy:
        pressed(mortal, proxy)
        (first,) = fetching()
        os.kill(first, signal.SIGKILL)
        until(lambda: fetching() not in (set(), {first}))
        pressed(mortal, proxy)
        assert proxy.error is None


# -- servers that never answer ---------------------------------------------------------------------


@contextmanager
def stalling(answer: Callable[[ServerConnection], None], port: int = 0) -> Iterator[str]:
    """URL of a server that answers a client's first message as it is told, and no other."""

    def work(connection: ServerConnection) -> None:
        with suppress(ConnectionClosed):
            connection.recv(PATIENCE)
            answer(connection)
            while True:
                connection.recv(PATIENCE)

    with serve(work, "127.0.0.1", port, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()
        joined(thread)


def test_a_server_that_accepts_and_never_answers_is_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(contact_proxy, "PATIENCE", 0.5)
    with (
        socket.create_server(("127.0.0.1", 0)) as listening,
        pytest.raises(ConnectionLostError, match="cannot be reached"),
    ):
        ContactProxy(f"ws://127.0.0.1:{listening.getsockname()[1]}")


def test_a_server_that_never_grants_a_tool_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contact_connection, "GRANTED_WITHIN", 0.5)
    with (
        stalling(lambda _: None) as url,
        pytest.raises(ConnectionLostError, match="does not answer"),
    ):
        ContactProxy(url)


@pytest.mark.parametrize("damping", [-1.0, np.nan, np.inf])
def test_a_wrong_damping_is_refused_before_anything_is_connected(damping: float) -> None:
    with pytest.raises(UsageError, match="give 0 or more"):
        ContactProxy("ws://127.0.0.1:9", damping=damping)  # where no server is


def test_a_connection_that_is_made_while_the_proxy_closes_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[contact_connection.ContactConnection] = []
    is_trying, may_go_on = threading.Event(), threading.Event()

    def slow(url: str, *wish: Any) -> contact_connection.ContactConnection:  # noqa: ANN401 - as `connect`
        is_trying.set()
        assert may_go_on.wait(PATIENCE)
        made.append(contact_connection.connect(url, *wish))
        return made[-1]

    monkeypatch.setattr(contact_proxy, "RECONNECT_EVERY", 0.01)
    with stalling(lambda c: c.send(pack_terms(TERMS))) as url:
        proxy = ContactProxy(url)
        monkeypatch.setattr(contact_proxy, "connect", slow)
        assert proxy._connection is not None
        proxy._connection.close()
        assert is_trying.wait(PATIENCE)
        monkeypatch.setattr(contact_proxy, "PATIENCE", 0.01)  # `close` waits no longer
        proxy.close()
        may_go_on.set()
        for thread in proxy._threads:
            joined(thread)
        (connection,) = made
        with pytest.raises(ConnectionLostError):
            connection.receive()


@pytest.mark.long
def test_the_force_comes_back_after_a_server_that_talks_nonsense(mortal: Served) -> None:
    with ContactProxy(mortal.url()) as proxy:
        pressed(mortal, proxy)
        ended(mortal)
        falls_to_zero(mortal, proxy)
        with stalling(lambda connection: connection.send(b"nonsense"), mortal.port):
            until(lambda: isinstance(proxy.error, ProtocolError))
        with started(mortal.file, mortal.plate, mortal.origin, port=mortal.port) as again:
            until(lambda: proxy.wrench(again.pose(-DEPTH), STILL)[2] == 0.0 and proxy.told.is_fresh)
            pressed(again, proxy)
