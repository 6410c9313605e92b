"""The page lets in the browsers that the server announced, and nobody else."""

import json
import socket
from collections.abc import Iterator

import pytest
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from children import until
from hapticdb.page.link import LATE, Announced, PageLink, announcement

PROTOCOL = [Subprotocol(f"viser-v{viser.__version__}")]


@pytest.fixture
def page() -> Iterator[tuple[socket.socket, PageLink, viser.ViserServer]]:
    ours, theirs = socket.socketpair()
    ours.settimeout(20.0)
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    link = PageLink(theirs.detach())
    link.guard(server)
    yield ours, link, server
    server.stop()
    ours.close()


def bound() -> socket.socket:
    found = socket.socket()
    found.bind(("127.0.0.1", 0))
    return found


def said(ours: socket.socket) -> dict[str, object]:
    received = b""
    while not received.endswith(b"\n"):
        received += ours.recv(1)
    found: dict[str, object] = json.loads(received)
    return found


def test_an_announced_browser_is_let_in_under_its_name(
    page: tuple[socket.socket, PageLink, viser.ViserServer],
) -> None:
    ours, link, server = page
    sock = bound()
    port = sock.getsockname()[1]
    ours.sendall(announcement(port, "Guest 1", "toucher"))
    assert said(ours) == {"word": "expected", "port": port}
    sock.connect(("127.0.0.1", server.get_port()))
    with connect(
        f"ws://127.0.0.1:{server.get_port()}", sock=sock, subprotocols=PROTOCOL
    ) as socket_:
        assert said(ours) == {"word": "connected", "port": port}
        assert socket_.recv(timeout=20.0)
        assert link.announced(0) == Announced("Guest 1", "toucher")
    assert said(ours)["word"] == "closed"
    until(lambda: _is_gone(link))


def _is_gone(link: PageLink) -> bool:
    try:
        link.announced(0)
    except KeyError:
        return True
    return False


def test_whoever_was_not_announced_is_sent_away_with_nothing(
    page: tuple[socket.socket, PageLink, viser.ViserServer],
) -> None:
    ours, _, server = page
    server.scene.add_label("/secret", "secret")
    ours.sendall(announcement(1, "Guest 1", "editor"))
    assert said(ours)["word"] == "expected"
    for _ in range(3):
        address = f"ws://127.0.0.1:{server.get_port()}"
        with connect(address, subprotocols=PROTOCOL) as browser:
            with pytest.raises(ConnectionClosed) as closed:
                browser.recv(timeout=20.0)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == LATE
        assert said(ours)["word"] == "refused"
    assert server.get_clients() == {}


def test_a_port_is_good_for_one_connection(
    page: tuple[socket.socket, PageLink, viser.ViserServer],
) -> None:
    ours, _, server = page
    sock = bound()
    port = sock.getsockname()[1]
    ours.sendall(announcement(port, "Guest 1", "viewer"))
    said(ours)
    address = f"ws://127.0.0.1:{server.get_port()}"
    sock.connect(("127.0.0.1", server.get_port()))
    with connect(address, sock=sock, subprotocols=PROTOCOL) as first:
        assert first.recv(timeout=20.0)
        with connect(address, subprotocols=PROTOCOL) as second, pytest.raises(ConnectionClosed):
            second.recv(timeout=20.0)
