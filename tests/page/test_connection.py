"""The page lets in the connections of its server, and nobody else."""

import socket
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import pytest
import viser
from websockets.datastructures import Headers, HeadersLike
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from children import TIMEOUT, until
from hapticdb.page.connection import (
    BREAKS_RULES,
    LATE,
    LONGEST_WORDS,
    MOST_FAILED,
    NAME,
    PING,
    PONG,
    REFUSED,
    ROLE,
    SECRET,
    PageConnection,
    Visitor,
)
from serving import CAMERA, PROTOCOL, close_code, sent


class Page(NamedTuple):
    """Our end of the page's socket, the page's end, and viser's server."""

    ours: socket.socket
    link: PageConnection
    server: viser.ViserServer

    @property
    def address(self) -> str:
        return f"ws://127.0.0.1:{self.server.get_port()}"


@pytest.fixture
def page() -> Iterator[Page]:
    ours, theirs = socket.socketpair()
    ours.settimeout(TIMEOUT)
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    link = PageConnection(theirs.detach(), "the secret")
    link.guard(server)
    yield Page(ours, link, server)
    server.stop()
    ours.close()


def reached(page: Page, headers: HeadersLike) -> ClientConnection:
    """A connection to the page with these headers."""
    return connect(
        page.address, additional_headers=headers, subprotocols=PROTOCOL, open_timeout=TIMEOUT
    )


def entered(page: Page, role: str) -> ClientConnection:
    """A browser that is connected as the server connects it."""
    return reached(page, {SECRET: "the secret", NAME: "Guest 1", ROLE: role})


def said(ours: socket.socket) -> bytes:
    received = b""
    while not received.endswith(b"\n"):
        received += ours.recv(1)
    return received


def test_connection_with_secret(page: Page) -> None:
    with entered(page, "toucher") as browser:
        assert browser.recv(timeout=TIMEOUT)
        assert page.link.visitor(0) == Visitor("Guest 1", "toucher")
        page.ours.sendall(PING)
        assert said(page.ours) == PONG
    until(lambda: 0 not in page.link._live)


@pytest.mark.parametrize(
    "shown",
    [
        {},
        {SECRET: ""},
        {SECRET: "a guess"},
        {SECRET: "the secre"},
        [(SECRET, "the secret"), (SECRET, "the secret")],
    ],
)
def test_connection_without_secret_refused(page: Page, shown: dict[str, str]) -> None:
    page.server.scene.add_label("/secret", "secret")
    named = Headers(shown)
    named.update({NAME: "Guest 1", ROLE: "editor"})
    with reached(page, named) as browser:
        with pytest.raises(ConnectionClosed) as closed:
            browser.recv(timeout=TIMEOUT)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == LATE
    assert said(page.ours) == REFUSED
    assert page.server.get_clients() == {}


def test_connection_viser_errors_one_line(
    page: Page, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    """Asyncio would write a traceback for each of them."""
    server = page.server
    slider = server.gui.add_slider("slider", 0.0, 1.0, 0.1, 0.5)
    vector = server.gui.add_vector3("vector", (0.0, 0.0, 0.0))
    server.scene.on_click()(lambda _: None)
    click: dict[str, object] = {
        "type": "ScenePointerMessage", "event_type": "click", "ray_origin": None,
        "ray_direction": None, "screen_pos": [], "modifier": None,
    }  # fmt: skip
    update = {"type": "GuiUpdateMessage", "uuid": slider._impl.uuid}
    wrong = [
        click,
        update | {"updates": {"value": "x" * 1000 + "\n"}},
        update | {"updates": {"value": None}},
        update | {"uuid": vector._impl.uuid, "updates": {"value": None}},
        update | {"uuid": vector._impl.uuid, "updates": {"value": ["a", "b", "c"]}},
    ]
    for _ in range(2):
        caplog.clear()
        with entered(page, "viewer") as browser:
            sent(browser, CAMERA)
            until(lambda: bool(server.get_clients()))
            for number in range(MOST_FAILED):
                sent(browser, wrong[number % len(wrong)])
            with suppress(ConnectionClosed):  # the page may be quicker than this message
                sent(browser, update | {"updates": {"value": 0.7}})
            assert close_code(browser) == BREAKS_RULES
        until(lambda: not server.get_clients())
        lines = [record.getMessage() for record in caplog.records if record.name != "websockets"]
        assert len(lines) == MOST_FAILED
        for record in caplog.records:
            assert record.exc_info is None
            assert "\n" not in record.getMessage()
            assert len(record.getMessage()) < LONGEST_WORDS + 100
    assert "Traceback" not in "".join(capfd.readouterr())
