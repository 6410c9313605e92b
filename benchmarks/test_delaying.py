"""The relay adds its latency, keeps the order of bytes, and hands on the end of a connection."""

import socket
import threading
import time

import numpy as np
import pytest

from delaying import DelayingRelay, echo_trips


@pytest.mark.parametrize("seconds", [0.0, 0.02])
def test_a_round_trip_takes_the_added_latency_longer(seconds: float) -> None:
    trips = echo_trips(seconds, 20)
    assert trips.min() >= seconds
    assert (trips > 0.0).all()


def test_bytes_come_in_order_and_the_end_is_handed_on() -> None:
    sent = np.random.default_rng(3).bytes(1 << 20)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(30.0)

        def give() -> None:
            peer, _ = listening.accept()
            with peer:
                peer.sendall(sent)

        giving = threading.Thread(target=give, daemon=True)
        giving.start()
        with DelayingRelay(listening.getsockname()[1], 0.1) as relay:
            began = time.monotonic()
            with socket.create_connection(("127.0.0.1", relay.port), 30.0) as peer:
                got = b"".join(iter(lambda: peer.recv(65536), b""))
            assert time.monotonic() >= began + 0.05
        giving.join(30.0)
    assert got == sent
