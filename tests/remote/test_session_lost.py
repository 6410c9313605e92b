"""A session whose server stalls, vanishes or is restarted: no force, no wait, and force again."""

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest

from children import joined
from hapticdb import Environment, PointShell
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.realtime.session import Session
from hapticdb.testing import floor_voxels
from realtime.hands import Noted, still
from realtime.sessions import RATE, floored, until
from realtime.worlds import make, move
from remote.device_server import DeviceServer, impatient

DEEP = 0.010
"""Height (m) of the hand: its tool presses 2 mm into the floor."""
MANY = 100
"""Frames in which nothing may change any more."""


@pytest.fixture
def env(tmp_path: Path) -> Iterator[Environment]:
    with floored(make(tmp_path, bits=6)) as made:
        yield made


class Felt:
    """What the driver of a session's hand was told last, and how the session goes on."""

    def __init__(self, cells: ResidentCells, shell: PointShell, path: Path) -> None:
        self.path, self.cells = path, cells
        self.session = Session(cells, shell, Noted(still(DEEP), path), rate=RATE)
        self.until_pressed()

    @property
    def force(self) -> float:
        written = self.path.read_bytes() if self.path.exists() else b""
        return float(np.linalg.norm(np.frombuffer(written)[:3])) if len(written) == 48 else 0.0

    @property
    def is_free(self) -> bool:
        """Whether the driver was told a wrench of zeros, of either sign."""
        written = self.path.read_bytes()
        return len(written) == 48 and not np.frombuffer(written).any()

    @property
    def revision(self) -> int:
        last = self.session.last()
        return -1 if last is None else int(last["revision"][0])

    def until_pressed(self) -> None:
        until(lambda: self.force > 0.0, self.session)

    def frames_go_on(self) -> None:
        """Whole frames pass; nobody answers meanwhile, so a frame that waits would not end."""
        n_frames = self.session.n_frames
        until(lambda: self.session.n_frames > n_frames + MANY, self.session)

    def until_nothing_is_felt(self) -> None:
        """The force has fallen to zero, stays there, and the frames go on."""
        until(lambda: self.is_free, self.session)
        self.frames_go_on()
        assert self.force == 0.0
        assert self.cells.is_away


@pytest.fixture
def feel(sphere: PointShell, tmp_path: Path) -> Iterator[Callable[[ResidentCells], Felt]]:
    begun: list[Felt] = []

    def begin(cells: ResidentCells) -> Felt:
        begun.append(Felt(cells, sphere, tmp_path / "force"))
        return begun[-1]

    yield begin
    for felt in begun:
        felt.session.close()


def test_a_server_that_stalls_is_not_felt_and_felt_again_when_it_goes_on(
    env: Environment, feel: Callable[[ResidentCells], Felt], tmp_path: Path
) -> None:
    with DeviceServer(tmp_path / "log") as server, ResidentCells(server.url(env.url)) as cells:
        felt = feel(cells)
        with server.stalled():
            felt.until_nothing_is_felt()
        felt.until_pressed()


def test_a_server_that_vanishes_is_felt_again_when_another_has_its_place(
    env: Environment, feel: Callable[[ResidentCells], Felt], tmp_path: Path
) -> None:
    """What was written meanwhile is felt, too."""
    with DeviceServer(tmp_path / "log") as server, ResidentCells(server.url(env.url)) as cells:
        felt = feel(cells)
        server.kill()
        felt.until_nothing_is_felt()
        up = floor_voxels(env.grid, width=48)
        move(env.store, 1, up - np.array([0, 0, 3]))
        move(env.store, 1, up)
        felt.frames_go_on()
        with DeviceServer(tmp_path / "log", port=server.port):
            felt.until_pressed()
            until(lambda: felt.revision == env.store.revision(), felt.session)
            felt.until_pressed()
            assert cells.restarts == 0  # the process that fetches goes on, too


class Cable:
    """A way to a server that loses all bytes while it is cut; no end of it is told."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._is_cut = threading.Event()
        self._open: list[socket.socket] = [self._listening]
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()
        self.port = int(self._listening.getsockname()[1])

    def cut(self) -> None:
        self._is_cut.set()

    def mend(self) -> None:
        """New connections pass; those from before the cut stay as they are, and lead nowhere."""
        self._is_cut = threading.Event()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listening.accept()
                far = socket.create_connection(("127.0.0.1", self._to))
                self._open += [near, far]
                for ends in ((near, far), (far, near)):
                    thread = threading.Thread(target=self._carry, args=(*ends, self._is_cut))
                    self._threads.append(thread)
                    thread.start()

    @staticmethod
    def _carry(here: socket.socket, there: socket.socket, is_cut: threading.Event) -> None:
        with suppress(OSError):
            while data := here.recv(1 << 16):
                if not is_cut.is_set():
                    there.sendall(data)

    def close(self) -> None:
        for end in self._open:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        for thread in self._threads:
            joined(thread)


@pytest.mark.long
def test_a_cable_that_is_pulled_is_noticed_though_nobody_tells_of_it(
    env: Environment,
    feel: Callable[[ResidentCells], Felt],
    device_server: DeviceServer,
) -> None:
    with closing(Cable(device_server.port)) as cable:
        url = device_server.url(env.url, port=cable.port)
        with ResidentCells(url, wrap=impatient) as cells:
            felt = feel(cells)
            cable.cut()
            felt.until_nothing_is_felt()
            until(lambda: cells.figures().losses, felt.session)
            cable.mend()
            felt.until_pressed()
            felt.session.close()


@pytest.mark.long
def test_a_fetching_process_that_dies_while_the_server_stalls_is_replaced(
    env: Environment, feel: Callable[[ResidentCells], Felt], tmp_path: Path
) -> None:
    with DeviceServer(tmp_path / "log") as server, ResidentCells(server.url(env.url)) as cells:
        felt = feel(cells)
        with server.stalled():
            felt.until_nothing_is_felt()
            os.kill(cells.pid, signal.SIGKILL)
            until(lambda: cells.restarts, felt.session)
            felt.frames_go_on()
            assert felt.force == 0.0
        felt.until_pressed()
