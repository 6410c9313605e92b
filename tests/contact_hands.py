"""Hands for tests of contact proxies, and servers in processes of their own that they feel."""

import contextlib
import random
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.sync.client import ClientConnection, connect

from children import PATIENCE, PIPE, child, until
from contact_server import TOKEN
from feel.ground import Ground
from feel.scenes import plane
from feel.tools import flat_tool
from hapticdb.client.contact_proxy import ContactProxy
from hapticdb.kernels.compiling import compile_missing, entries_for
from hapticdb.protocol.contacts import HandState, ProxyWish, pack_hand, pack_wish, unpack_terms

Floats = NDArray[np.float64]
SIZE = 0.005
DEPTH = 0.003
"""Metres below the onset of contact at which hands rest."""
STILL = np.zeros(6)


class Served:
    """A server's process, its port, and where the surface is."""

    def __init__(
        self, process: "subprocess.Popen[str]", origin: Floats, file: str, plate: Path
    ) -> None:
        self.process, self.origin, self.file, self.plate = process, origin, file, plate
        assert process.stdout is not None
        self.port = int(process.stdout.readline() or 0)

    def url(self, token: str = TOKEN) -> str:
        return f"ws://127.0.0.1:{self.port}?token={token}"

    def pose(self, depth: float) -> Floats:
        """Hand (4, 4) whose plate is at a depth below the onset of contact, m."""
        pose = np.eye(4)
        pose[:3, 3] = self.origin
        pose[2, 3] += 1.5 * SIZE - depth
        return pose


def lasting_port() -> int:
    """A free port that no client is given in the meantime, when a test ends and restarts a server.

    Clients get ports from 32,768 on. One of them may get the port of a server that has just ended.
    """
    rng = random.SystemRandom()
    for _ in range(100):
        port = rng.randrange(20_000, 32_000)
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
    pytest.fail("no free port among 100")


def ended(served: Served) -> None:
    """Kill a server and wait until it is gone, and its port is free."""
    served.process.kill()
    served.process.wait(PATIENCE)


@contextlib.contextmanager
def serving(folder: Path, **options: float) -> Iterator[Served]:
    """A server over a level plane, with a flat tool; killed at the end, frozen or not."""
    compile_missing(entries_for("resident", "proxies", "proxy"))  # no force waits for it
    with Ground.of_scenes(folder, [plane("level", np.eye(3))], SIZE, distances=True) as ground:
        origin = ground.origins["level"]
    (url,) = folder.glob("*.db")
    flat_tool(3, SIZE, np.eye(3)).save(folder / "plate.npz")
    with started(str(url), folder / "plate.npz", origin, **options) as server:
        yield server


@contextlib.contextmanager
def started(url: str, plate: Path, origin: Floats, **options: float) -> Iterator[Served]:
    """A server over an environment that is there; options as `contact_server` takes them."""
    program = str(Path(__file__).with_name("contact_server.py"))
    given = [f"--{name}={value}" for name, value in options.items()]
    with child(
        [sys.executable, program, url, str(plate), *given], stdin=PIPE, stderr=None
    ) as process:
        try:
            yield Served(process, origin, url, plate)
        finally:
            process.kill()


def pressed(served: Served, proxy: ContactProxy) -> Floats:
    """Come down to DEPTH and wait until the force is that of a spring; returns the wrench.

    The server has to see the hand while it is free: where it sees it first, it puts the tool.
    """
    free = served.pose(-0.002)
    until(lambda: (proxy.wrench(free, STILL), proxy.told.is_fresh)[1], every=2e-3)
    for depth in np.linspace(-0.002, DEPTH, 200):
        proxy.wrench(served.pose(depth), STILL)
        time.sleep(2e-3)
    full = pytest.approx(1000.0 * DEPTH, rel=0.06)
    felt = np.zeros(6)

    def is_full() -> bool:
        felt[:] = proxy.wrench(served.pose(DEPTH), STILL)
        return bool(felt[2] == full)

    until(is_full, every=1e-3)
    return felt


def falls_to_zero(served: Served, proxy: ContactProxy) -> list[float]:
    """Forces along z until there is none."""
    felt: list[float] = []

    def is_gone() -> bool:
        felt.append(float(proxy.wrench(served.pose(DEPTH), STILL)[2]))
        return felt[-1] == 0.0

    until(is_gone, every=1e-3)
    return felt


def granted(served: Served) -> ClientConnection:
    """A connection to which the server has granted its tool."""
    connection = connect(
        f"ws://127.0.0.1:{served.port}/device/contacts", compression=None, proxy=None,
        additional_headers={"Authorization": f"Bearer {TOKEN}"}, open_timeout=PATIENCE,
    )  # fmt: skip
    connection.send(pack_wish(ProxyWish()))
    assert unpack_terms(connection.recv(PATIENCE)).tool == "plate"  # type: ignore[arg-type]
    return connection


def hand_at(served: Served, sequence: int, seen: int = 0) -> bytes:
    position = served.pose(DEPTH)[:3, 3]
    return pack_hand(
        HandState(sequence, time.monotonic(), position, np.eye(4)[0], STILL, seen=seen)
    )
