"""What a stranger, another site, or a client that misbehaves can do: nothing."""

import contextlib
import errno
import os
import signal
import socket
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

import hapticdb
from children import TIMEOUT, descendants, named, until
from hapticdb.errors import UsageError
from hapticdb.server import access, page_supervisor, relay
from hapticdb.server.access import Role
from hapticdb.server.limits import Limits
from hapticdb.server.served import Serving, check
from hapticdb.session.processes.process import Process
from serving import CAMERA, TOKENS, Running, browser_at, close_code, running, sent, text_until, urls

EDITOR = "a-token-for-editor"


@pytest.fixture(scope="module")
def server(environment: Path) -> Iterator[Running]:
    limits = replace(Limits(), browsers_at_once=2000.0, sign_ins_at_once=30.0, bad_messages=1000)
    serving = Serving(urls(environment), tokens=TOKENS, limits=limits, page="viser_page:work")
    with running(serving) as found:
        yield found


def test_server_without_token_form_only(server: Running) -> None:
    answer, body = server.ask("/")
    assert (answer.status, b"viser" in body.lower()) == (401, False)
    with pytest.raises(InvalidStatus):
        server.browser()


def test_server_token_to_http_only_cookie(server: Running) -> None:
    answer, body = server.ask(f"/?token={EDITOR}")
    assert answer.status == 200
    assert EDITOR.encode() not in body
    cookie, *flags = (part.strip() for part in str(answer.getheader("set-cookie")).split(";"))
    assert {flag.lower() for flag in flags} == {"httponly", "samesite=strict", "path=/"}
    answer, body = server.ask("/", cookie=cookie)
    assert (answer.status, b"data-p=" in body) == (200, True)
    with server.browser(None, Cookie=cookie) as browser:
        sent(browser, CAMERA)
        assert "is a editor" in text_until(browser, "is a editor")


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", ""])
def test_server_rebound_host_refused(server: Running, host: str) -> None:
    answer, _ = server.ask("/healthz", Host=host)
    assert answer.status in {400, 403}
    with pytest.raises(InvalidStatus):
        server.browser(Role.EDITOR, Host=host)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "file://"])
def test_server_cross_origin_refused(server: Running, origin: str) -> None:
    with pytest.raises(InvalidStatus):
        server.browser(Role.EDITOR, Origin=origin)
    answer, _ = server.ask("/", "POST", f"token={EDITOR}".encode(), Origin=origin)
    assert (answer.status, answer.getheader("set-cookie")) == (403, None)


def test_server_socket_without_origin_needs_token(server: Running) -> None:
    """Browsers send the header with every WebSocket."""
    with server.browser(Role.EDITOR, Origin="") as program:
        sent(program, CAMERA)
        assert "is a editor" in text_until(program, "is a editor")
    with pytest.raises(InvalidStatus):
        server.browser(None, Origin="")


def test_server_form_origin_and_size(server: Running) -> None:
    assert server.ask("/", "POST", b"token=x")[0].status == 403
    own = f"http://{server.place}"
    assert server.ask("/", "POST", b"x" * 5000, Origin=own)[0].status == 413
    answer, _ = server.ask("/", "POST", f"token={EDITOR}".encode(), Origin=own)
    assert (answer.status, answer.getheader("location")) == (303, "/")


def test_server_link_to_objects_after_sign_in(server: Running) -> None:
    _, body = server.ask(f"/see/1,2?token={EDITOR}&initialCameraNear=3")
    assert b'url=/see/1,2?initialCameraNear=3"' in body
    shown = {"Authorization": f"Bearer {EDITOR}"}
    with browser_at(f"{server.place}/see/1,2", **shown) as client:
        sent(client, CAMERA)
        assert "is a editor (1, 2)" in text_until(client, "is a editor")
    with pytest.raises(InvalidStatus):
        browser_at(f"{server.place}/see/1,x", **shown)


def test_server_security_headers(server: Running) -> None:
    for path in ("/", "/healthz", "/no/such/path", f"/?token={EDITOR}"):
        answer, body = server.ask(path)
        policy = str(answer.getheader("content-security-policy"))
        assert "frame-ancestors 'none'" in policy
        assert "unsafe-eval" not in policy.replace("wasm-unsafe-eval", "")
        assert answer.getheader("x-content-type-options") == "nosniff"
        assert answer.getheader("referrer-policy") == "same-origin"
        assert b"Traceback" not in body
        assert str(Path.cwd()).encode() not in body


def test_server_metrics_access(server: Running) -> None:
    assert b"hapticdb_sessions" in server.ask("/metrics")[1]
    far = "203.0.113.7"
    assert server.ask("/metrics", X_Forwarded_For=far)[0].status == 403
    shown = f"Bearer {EDITOR}"
    assert server.ask("/metrics", X_Forwarded_For=far, Authorization=shown)[0].status == 200


def test_server_malformed_messages_dropped(server: Running) -> None:
    with server.browser(Role.EDITOR) as healthy, server.browser(Role.EDITOR) as bad:
        for browser in (healthy, bad):
            sent(browser, CAMERA)
        for message in (b"", b"\xc1", b"\x91" * 500, os.urandom(200)):
            bad.send(message)
        bad.send("text")
        sent(bad, {"type": "ShareUrlRequest"})
        text_until(bad, "is a editor")
        text_until(healthy, "is a editor")
        # the page may answer before the last message is judged
        until(lambda: is_counted(server, 'relay_messages_dropped_total{reason="type"} 1.0'))


def is_counted(server: Running, figure: str) -> bool:
    """Whether the server shows that figure."""
    return f"hapticdb_{figure}\n" in server.ask("/metrics")[1].decode()


def test_server_flood_throttled_then_closed(environment: Path) -> None:
    limits = replace(Limits(), messages_per_second=100.0, messages_at_once=10.0,
                     throttled_seconds=0.5)  # fmt: skip
    serving = Serving(urls(environment), tokens=TOKENS, limits=limits, page="viser_page:work")
    with running(serving) as server, server.browser(Role.EDITOR) as browser:
        with contextlib.suppress(ConnectionClosed):
            for _ in range(2000):
                sent(browser, CAMERA)
        assert close_code(browser) == 1008
        until(lambda: is_counted(server, 'browser_connections_total{end="flood"} 1.0'))


def test_server_killed_page_restarts(environment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No process is to be had for a moment; nothing stays open of the tries, browsers come back."""
    serving = Serving(urls(environment), tokens=TOKENS, prefix="/hapticdb", page="viser_page:work")
    tries: list[int] = []
    others = _pages()

    def begin(*given: Any) -> Process:  # noqa: ANN401 - as Process takes them
        tries.append(len(list(Path("/proc/self/fd").iterdir())))
        if len(tries) < 3:
            raise BlockingIOError(errno.EAGAIN, "no room for a process")
        return Process(*given)

    monkeypatch.setattr(page_supervisor, "FIRST_PAUSE", 0.05)
    with running(serving) as server:
        monkeypatch.setattr(page_supervisor, "Process", begin)
        with server.browser(Role.EDITOR) as browser:
            sent(browser, CAMERA)
            text_until(browser, "is a editor")
            (pid,) = _pages() - others  # the page of this server; other tests use the others
            os.kill(pid, signal.SIGKILL)
            assert close_code(browser) in {1001, 1006}
        until(lambda: len(tries) == 3)
        until(lambda: _is_back(server))
    assert tries[1] <= tries[0]


def _pages() -> set[int]:
    """Processes of pages, of all servers that run here."""
    return {pid for pid in descendants(os.getpid()) if named(pid) == "hdb-viser_page"}


def _is_back(server: Running) -> bool:
    try:
        with server.browser(Role.VIEWER) as browser:
            sent(browser, CAMERA)
            return "is a viewer" in text_until(browser, "is a viewer")
    except (InvalidStatus, ConnectionClosed):
        return False


def test_server_silent_and_pipelined_requests_cut(environment: Path) -> None:
    """No request, half of one, a form that does not come, and a second request."""
    limits = replace(Limits(), request_seconds=0.2)
    serving = Serving(urls(environment), tokens=TOKENS, limits=limits, page="viser_page:work")
    with running(serving) as server:
        host = f"Host: {server.place}\r\n"
        form = f"Origin: http://{server.place}\r\nContent-Length: 2000\r\n"
        for said, answer in (
            ("", b""),
            ("GET / HTTP/1.1\r\nHost: x\r\nX: ", b""),
            (f"POST / HTTP/1.1\r\n{host}{form}\r\n", b"HTTP/1.1 408 "),
            # nothing answers the first letter of the next request
            (f"GET /none HTTP/1.1\r\n{host}\r\nG", b"HTTP/1.1 404 "),
        ):
            until(lambda s=said, a=answer: _all_read(server, s)[:13] == a)  # type: ignore[misc]


def _all_read(server: Running, said: str) -> bytes:
    """What the server says until it cuts the connection; nothing if it was quicker than we are."""
    with (
        socket.create_connection(("127.0.0.1", server.port), TIMEOUT) as slow,
        contextlib.suppress(ConnectionError),
    ):
        slow.sendall(said.encode())
        return b"".join(iter(lambda: slow.recv(1 << 16), b""))
    return b""


def test_server_stale_cookie_with_open_role(environment: Path) -> None:
    serving = Serving(urls(environment), open_role=Role.TOUCHER, page="viser_page:work")
    with running(serving) as server:
        cookie = f"hapticdb-{server.port}=of-an-earlier-run"
        with server.browser(None, Cookie=cookie) as browser:
            sent(browser, CAMERA)
            until(lambda: is_counted(server, "relay_messages_total 1.0"))
            text_until(browser, "clock")


def test_server_expired_cookie_closes_connection(
    server: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(relay, "RENEW_EVERY", -1.0)
    answer, _ = server.ask(f"/?token={EDITOR}")
    cookie = str(answer.getheader("set-cookie")).partition(";")[0]
    with server.browser(None, Cookie=cookie) as browser:
        monkeypatch.setattr(access, "SIGNED_IN_SECONDS", -1.0)
        sent(browser, CAMERA)  # its look begins the time anew
        with contextlib.suppress(ConnectionClosed):  # another look may be earlier than the message
            sent(browser, CAMERA)
        assert close_code(browser) == 4401


def test_server_page_start_error(environment: Path) -> None:
    serving = Serving(urls(environment), tokens=TOKENS, page="viser_page:fail")
    with pytest.raises(hapticdb.errors.HapticDBError, match="no such scene"), running(serving):
        pass


@pytest.mark.parametrize("host", ["::", "192.0.2.1", "example.org", "10.0.0.1"])
def test_check_serving_public_address_needs_token(host: str) -> None:
    serving = Serving(urls("car.db"), open_role=Role.EDITOR, host=host)
    with pytest.raises(UsageError, match="--token"):
        check(serving)
    check(replace(serving, open_role=None, tokens=TOKENS))
