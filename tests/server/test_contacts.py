"""Remote hands against a server in a process of its own: force, faults, floods."""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Close
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection
from websockets.typing import Origin

from children import PATIENCE, child, until
from contact_hands import DEPTH, SIZE, STILL, Served, granted, hand_at, pressed, serving
from contact_server import TOKEN
from feel.ground import Ground
from feel.scenes import plane
from hapticdb.client.contact_proxy import ContactProxy
from hapticdb.errors import AccessError, ConnectionLostError, UsageError
from hapticdb.kernels.compiling import compile_missing, entries_for
from hapticdb.protocol.contacts import unpack_proxy
from hapticdb.server import contacts
from hapticdb.server.served import Serving
from serving import TOKENS, running, urls


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serving(tmp_path_factory.mktemp("served")) as server:
        yield server


def test_a_remote_hand_feels_the_surface(served: Served) -> None:
    with ContactProxy(served.url(), "plate") as proxy:
        assert proxy.terms.center == (0.0, 0.0, 0.0)
        wrench = pressed(served, proxy)
        assert np.abs(wrench[:2]).max() < 0.2
        figures = proxy.figures()
        assert figures.proxies > 0
        assert figures.bytes <= (232 + 16 * 24) * figures.proxies
        for depth in np.linspace(DEPTH, -0.002, 50):
            proxy.wrench(served.pose(depth), STILL)
            time.sleep(2e-3)
        until(lambda: not proxy.wrench(served.pose(-0.002), STILL).any())


def test_a_wrong_token_an_unknown_tool_and_no_server_are_told(served: Served) -> None:
    with pytest.raises(AccessError, match="token"):
        ContactProxy(served.url("some-other-token-of-nobody"))
    with pytest.raises(UsageError, match="no tool of that name: there are plate"):
        ContactProxy(served.url(), "hammer")
    with socket.socket() as deaf:  # it has a port, and does not listen
        deaf.bind(("127.0.0.1", 0))
        with pytest.raises(ConnectionLostError, match="cannot be reached"):
            ContactProxy(f"ws://127.0.0.1:{deaf.getsockname()[1]}")


def test_a_page_of_a_browser_is_refused(served: Served) -> None:
    with pytest.raises(InvalidStatus) as refused:
        connect(
            f"ws://127.0.0.1:{served.port}/device/contacts", origin=Origin("http://evil.example"),
            additional_headers={"Authorization": f"Bearer {TOKEN}"}, proxy=None,
        )  # fmt: skip
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize(
    ("message", "code", "reason"),
    [
        (b"hd\x01\x80" + bytes(40), 4400, "inside a field"),
        (bytes(1025), 4400, "at most 1024"),
        (b"hd\x02\x80" + bytes(96), 4426, "version 2"),
    ],
)
def test_a_malformed_message_closes_with_a_plain_reason(
    served: Served, message: bytes | str, code: int, reason: str
) -> None:
    with granted(served) as connection:
        connection.send(message)
        frame = closed_by(connection)
    assert frame.code == code
    assert reason in frame.reason


def closed_by(connection: Connection) -> Close:
    """What the server says at a connection's end, after the messages before it."""
    with pytest.raises(ConnectionClosed) as closed:
        deque(iter(lambda: connection.recv(PATIENCE), None), maxlen=0)
    assert closed.value.rcvd is not None
    return closed.value.rcvd


def test_the_first_message_must_come_and_be_of_this_version(
    environment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the server that people start; it tells when it ends, too."""
    monkeypatch.setattr(contacts, "FIRST_WITHIN", 0.3)
    shown = {"Authorization": "Bearer a-token-for-toucher"}
    with running(Serving(urls(environment), tokens=TOKENS, page="viser_page:work")) as server:
        address = f"ws://{server.place}/device/contacts"

        def reached() -> ClientConnection:
            return connect(
                address, additional_headers=shown, proxy=None, compression=None,
                open_timeout=PATIENCE,
            )  # fmt: skip

        with reached() as silent:
            assert closed_by(silent).code == 4408
        monkeypatch.undo()
        with reached() as talking:
            talking.send("text")
            assert closed_by(talking).code == 4400
        last = reached()
    with last:
        assert closed_by(last).code in {1001, 1012}


@pytest.mark.parametrize("seen", [0, 0xFFFFFFFF])
def test_a_client_that_does_not_read_gets_no_queue(served: Served, seen: int) -> None:
    """Without an acknowledgement the server sends no more than a third of a second's proxies.

    Nor with one of a proxy that was not sent.
    """
    with granted(served) as connection:
        connection.send(hand_at(served, 1, seen))
        sequences = [unpack_proxy(connection.recv(PATIENCE)).sequence]  # type: ignore[arg-type]
        began = time.monotonic()
        while time.monotonic() < began + 1.5:
            connection.send(hand_at(served, len(sequences) + 1, seen))
            try:
                proxy = unpack_proxy(connection.recv(0.02))  # type: ignore[arg-type]
            except TimeoutError:
                continue
            sequences.append(proxy.sequence)
    assert len(sequences) <= 40
    assert sequences == sorted(sequences)


def test_a_flood_of_malformed_messages_leaves_others_alone(served: Served) -> None:
    """20,000 messages from 40 clients, 500 of each at once, beside a hand that feels."""
    random = np.random.default_rng(11)

    def flood() -> None:
        for _ in range(40):
            with granted(served) as connection:
                for _ in range(500):
                    connection.protocol.send_binary(random.bytes(int(random.integers(0, 200))))
                with contextlib.suppress(OSError):  # closed at the first one
                    connection.socket.sendall(b"".join(connection.protocol.data_to_send()))

    with ContactProxy(served.url()) as proxy:
        pressed(served, proxy)
        before = proxy.figures()
        flooding = threading.Thread(target=flood, daemon=True)
        flooding.start()
        until(
            lambda: (proxy.wrench(served.pose(DEPTH), STILL), not flooding.is_alive())[1],
            every=1e-3,
        )
        after = proxy.figures()
        assert after.losses == before.losses
        assert after.proxies > before.proxies
        pressed(served, proxy)
    assert served.process.poll() is None


@pytest.mark.long
def test_a_client_that_sends_nothing_is_dropped(tmp_path: Path) -> None:
    with serving(tmp_path, idle=0.5) as server:
        with granted(server) as connection:
            connection.send(hand_at(server, 1))
            assert closed_by(connection).code == 4408
        with ContactProxy(server.url()) as proxy:  # its place is free
            pressed(server, proxy)


@pytest.mark.long
def test_a_served_environment_has_the_endpoint_and_probes(tmp_path: Path) -> None:
    compile_missing(entries_for("resident", "proxies", "proxy"))
    with Ground.of_scenes(tmp_path, [plane("level", np.eye(3))], SIZE, distances=True) as ground:
        origin = ground.origins["level"]
    (url,) = tmp_path.glob("*.db")
    command = [sys.executable, "-m", "hapticdb", "serve", str(url), "--token"]
    with child(command, env=dict(os.environ)) as server:
        assert server.stdout is not None
        lines = dict(server.stdout.readline().split() for _ in range(3))
        links = {role: urlsplit(line) for role, line in lines.items()}
        viewer, toucher = (
            f"ws://{links[role].netloc}?{links[role].query}" for role in ("viewer", "toucher")
        )
        with pytest.raises(AccessError):
            ContactProxy(viewer, "ball")
        with pytest.raises(UsageError, match="ball, peg"):
            ContactProxy(toucher, "wrench")
        with ContactProxy(toucher, "ball") as proxy:
            pose = np.eye(4)
            pose[:3, 3] = origin + np.array([0.0, 0.0, 0.08])  # the ball is free there

            def is_pushed_up() -> bool:
                pose[2, 3] = max(pose[2, 3] - 2e-5, origin[2])
                return bool(proxy.wrench(pose, STILL)[2] >= 0.5)

            until(is_pushed_up, every=1e-3)
        server.send_signal(signal.SIGTERM)
        assert server.wait(PATIENCE) == 143
