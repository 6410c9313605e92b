"""What WebSockets run over: TLS that is verified, no compression, no delay of small segments."""

import socket
import ssl
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPSConnection
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from children import PATIENCE, finished
from hapticdb.client.opening import open_websocket, parse_address
from hapticdb.errors import AccessError, FileError
from hapticdb.server.access import Role
from hapticdb.server.served import Serving
from hapticdb.server.transports import StrictWebSocket
from serving import CAMERA, PROTOCOL, TOKENS, Running, running, sent, text_until, urls

TOKEN = "a-token-for-toucher"  # noqa: S105


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Files of a certificate of 127.0.0.1 that has signed itself, and of its key."""
    return made_certificate(tmp_path_factory.mktemp("tls"), "IP:127.0.0.1")


def made_certificate(folder: Path, name: str) -> tuple[str, str]:
    certificate, key = folder / "cert.pem", folder / "key.pem"
    command = [
        "openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
        "-nodes", "-days", "2", "-subj", "/CN=hapticdb", "-addext", f"subjectAltName={name}",
        "-keyout", str(key), "-out", str(certificate),
    ]  # fmt: skip
    finished(command, check=True)
    return str(certificate), str(key)


def served(environment: Path, certificate: tuple[str, str] | None) -> Serving:
    cert, key = certificate or (None, None)
    return Serving(
        urls(environment), tokens=TOKENS, certificate=cert, key=key, page="viser_page:work"
    )


def device(url: str) -> ClientConnection:
    return open_websocket(parse_address(url), PATIENCE)


@pytest.fixture(scope="module")
def secure(environment: Path, certificate: tuple[str, str]) -> Iterator[Running]:
    with running(served(environment, certificate)) as found:
        yield found


@pytest.mark.long
def test_every_connection_of_many_is_answered(
    secure: Running, certificate: tuple[str, str]
) -> None:
    """With tickets after the handshake, a few in a hundred were not."""
    for _ in range(150):
        with device(f"wss://{secure.place}?token={TOKEN}&ca={certificate[0]}") as link:
            link.send("text")
            with pytest.raises(ConnectionClosed):
                link.recv(PATIENCE)
            assert link.close_code == 4400


def test_a_client_trusts_the_file_that_it_is_given(
    secure: Running, certificate: tuple[str, str]
) -> None:
    device(f"wss://{secure.place}?token={TOKEN}&ca={certificate[0]}").close()


def test_a_stranger_is_not_trusted_and_gets_no_token(
    secure: Running, tmp_path: Path, environment: Path, certificate: tuple[str, str]
) -> None:
    """Neither an unknown certificate, nor that of another name, nor another file's."""
    url = f"wss://{secure.place}?token={TOKEN}"
    other, _ = made_certificate(tmp_path, "IP:127.0.0.1")
    for untrusted in (url, f"{url}&ca={other}"):
        with pytest.raises(AccessError, match=r"certificate is not trusted.*\?ca=FILE") as told:
            device(untrusted)
        assert TOKEN not in str(told.value)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    named = made_certificate(elsewhere, "DNS:haptics.example.org")
    with (
        running(served(environment, named)) as found,
        pytest.raises(AccessError, match="certificate is not trusted"),
    ):
        device(f"wss://{found.place}?token={TOKEN}&ca={named[0]}")
    with pytest.raises(FileError, match="no file of certificates"):
        device(f"{url}&ca={certificate[0]}.none")


def test_a_browser_uses_the_page_over_tls(secure: Running, certificate: tuple[str, str]) -> None:
    trust = ssl.create_default_context(cafile=certificate[0])
    with closing(HTTPSConnection("127.0.0.1", secure.port, timeout=PATIENCE, context=trust)) as ask:
        ask.request("GET", f"/?token={TOKEN}")
        answer = ask.getresponse()
        assert answer.status == 200
        assert "secure" in str(answer.getheader("set-cookie")).lower()
    shown = {"Origin": f"https://{secure.place}", "Authorization": f"Bearer {TOKEN}"}
    with connect(
        f"wss://{secure.place}", ssl=trust, subprotocols=PROTOCOL, additional_headers=shown,
        proxy=None, compression=None, open_timeout=PATIENCE,
    ) as browser:  # fmt: skip
        sent(browser, CAMERA)
        assert "is a toucher" in text_until(browser, "is a toucher")


def test_small_messages_leave_at_once_and_uncompressed(
    environment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TCP_NODELAY at both ends, for devices and browsers; no extension, even if asked for."""
    noted: list[int] = []
    begin = StrictWebSocket.connection_made

    def connection_made(self: StrictWebSocket, transport: Any) -> None:  # noqa: ANN401 - asyncio's
        begin(self, transport)
        own = transport.get_extra_info("socket")
        noted.append(own.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))

    monkeypatch.setattr(StrictWebSocket, "connection_made", connection_made)
    with running(served(environment, None)) as found:
        with device(f"ws://{found.place}?token={TOKEN}") as link:
            assert link.socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            assert link.request is not None
            assert "Sec-WebSocket-Extensions" not in link.request.headers
            assert link.protocol.extensions == []
        shown = {"Authorization": f"Bearer {TOKEN}"}
        page = shown | {"Origin": f"http://{found.place}"}
        for path, headers, protocols in (
            ("/device/contacts", shown, None),
            ("/", page, PROTOCOL),
        ):
            with connect(
                f"ws://{found.place}{path}", additional_headers=headers, subprotocols=protocols,
                proxy=None, compression="deflate", open_timeout=PATIENCE,
            ) as asking:  # fmt: skip
                assert asking.request is not None
                assert "permessage-deflate" in asking.request.headers["Sec-WebSocket-Extensions"]
                assert asking.protocol.extensions == []
    assert len(noted) == 3
    assert all(noted)


@pytest.mark.parametrize("role", [None, Role.VIEWER])
def test_over_tls_too_a_device_needs_the_right(
    secure: Running, certificate: tuple[str, str], role: Role | None
) -> None:
    token = f"&token=a-token-for-{role.word}" if role else ""
    with pytest.raises(AccessError, match="does not let this client in"):
        device(f"wss://{secure.place}?ca={certificate[0]}{token}")
