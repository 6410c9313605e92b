"""What WebSockets run over: TLS, no compression, no delay of small segments."""

import asyncio
import socket
import ssl
from contextlib import closing
from http.client import HTTPSConnection
from pathlib import Path
from typing import Any

import msgspec
import pytest
from websockets.asyncio.client import connect as connect_in_loop
from websockets.sync.client import connect

from children import TIMEOUT, finished
from hapticdb.server.served import Serving
from hapticdb.server.transports import StrictWebSocket
from serving import CAMERA, PROTOCOL, TOKENS, running, urls

TOKEN = "a-token-for-toucher"  # noqa: S105
SHOWN = {"Authorization": f"Bearer {TOKEN}"}


def test_server_page_over_tls(environment: Path, tmp_path: Path) -> None:
    certificate, key = str(tmp_path / "cert.pem"), str(tmp_path / "key.pem")
    command = [
        "openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
        "-nodes", "-days", "2", "-subj", "/CN=hapticdb", "-addext", "subjectAltName=IP:127.0.0.1",
        "-keyout", key, "-out", certificate,
    ]  # fmt: skip
    finished(command, check=True)
    trust = ssl.create_default_context(cafile=certificate)

    async def first_frame(place: str) -> str | bytes:
        async with connect_in_loop(
            f"wss://{place}", ssl=trust, subprotocols=PROTOCOL, proxy=None, compression=None,
            additional_headers=SHOWN | {"Origin": f"https://{place}"}, open_timeout=TIMEOUT,
        ) as browser:  # fmt: skip
            await browser.send(msgspec.msgpack.encode(CAMERA))
            return await asyncio.wait_for(anext(aiter(browser)), TIMEOUT)

    serving = Serving(
        urls(environment), tokens=TOKENS, certificate=certificate, key=key, page="viser_page:work"
    )
    with running(serving) as secure:
        asked = HTTPSConnection("127.0.0.1", secure.port, timeout=TIMEOUT, context=trust)
        with closing(asked):
            asked.request("GET", f"/?token={TOKEN}")
            answer = asked.getresponse()
            assert answer.status == 200
            assert "secure" in str(answer.getheader("set-cookie")).lower()
        assert len(asyncio.run(first_frame(secure.place))) > 16


def test_server_small_messages_undelayed_uncompressed(
    environment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TCP_NODELAY at the server's end; no extension, even if asked for."""
    noted: list[int] = []
    begin = StrictWebSocket.connection_made

    def connection_made(self: StrictWebSocket, transport: Any) -> None:  # noqa: ANN401 - asyncio's
        begin(self, transport)
        own = transport.get_extra_info("socket")
        noted.append(own.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))

    monkeypatch.setattr(StrictWebSocket, "connection_made", connection_made)
    serving = Serving(urls(environment), tokens=TOKENS, page="viser_page:work")
    with (
        running(serving) as found,
        connect(
            f"ws://{found.place}/", additional_headers=SHOWN | {"Origin": f"http://{found.place}"},
            subprotocols=PROTOCOL, proxy=None, compression="deflate", open_timeout=TIMEOUT,
        ) as asking,
    ):  # fmt: skip
        assert asking.request is not None
        assert "permessage-deflate" in asking.request.headers["Sec-WebSocket-Extensions"]
        assert asking.protocol.extensions == []
    assert noted == [1]
