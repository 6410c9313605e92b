"""The loop, frame by frame, when cells are lost, the hand leaves, or its process must end."""

import os
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from banded import write_points
from feel.ground import PITCH, flat_tool
from hapticdb import Grid, TangentPlane
from hapticdb.devices.handle import Handle
from hapticdb.devices.profiles import SCRIPTED
from hapticdb.devices.protocol import Reading
from hapticdb.errors import DeviceError
from hapticdb.kernels.period.loop import WITHDRAWN_NS
from hapticdb.query.law import DistanceField, ForceLaw
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.session import device_loop as subject
from hapticdb.session.coupling import Coupling, DirectRendering, rendering_of
from hapticdb.session.device_loop import DeviceLoop, DeviceRequest
from hapticdb.session.shared_table import SharedTable
from hapticdb.session.states import PeriodClock, SlotRequest
from hapticdb.session.timing import Timing
from hapticdb.session.worker import WorkerRequest, work
from session.hands import Heard, at
from session.sessions import floor_points
from session.worlds import block, cells_of
from voxels import write_voxels

Floats = NDArray[np.float64]
SIZE = 0.005
"""Voxel size in metres."""
BITS = 6
SIDE = 1 << BITS
N_RING = 64
MIDDLE = SIDE // 2
FLOOR = block((MIDDLE - 12, MIDDLE - 12, MIDDLE - 4), (MIDDLE + 11, MIDDLE + 11, MIDDLE - 1))


class World:
    """A floor in voxels of 5 mm about the world's origin; all cells are resident."""

    def __init__(self, *, has_distances: bool) -> None:
        self.grid = Grid(SIZE, (-SIZE * SIDE / 2,) * 3, BITS)
        self.table = CellTable.create(4 << 20, distances=has_distances)
        with (
            tempfile.TemporaryDirectory() as folder,
            hapticdb.create(Path(folder) / "world.db", self.grid) as env,
        ):
            if has_distances:
                write_points(env.store, floor_points(MIDDLE - 1.1))
            else:
                write_voxels(env.store, FLOOR)
            Residency(env.store, self.table).make_resident(cells_of(self.grid))


class Pressing:
    """A hand at height z (metres) that records the wrenches it is sent."""

    def __init__(self, z: float) -> None:
        self.z = z
        self.buttons = 0
        self.sent: list[Floats] = []

    def read(self) -> Reading:
        return Reading(at(0.0, 0.0, self.z), np.zeros(6), self.buttons)

    def apply(self, wrench: Floats) -> None:
        self.sent.append(wrench.copy())


@pytest.fixture(params=["plane", "distance"])
def world(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    """A floor that is felt directly, or through the coupling."""
    monkeypatch.setattr(
        subject, "parent_is_gone", lambda _=0.0: False
    )  # standard input may be closed
    monkeypatch.setattr(subject, "WARM_TIMEOUT", 0.0)  # no prefetch process exists
    before = signal.getsignal(signal.SIGTERM)
    made = World(has_distances=request.param == "distance")
    yield made
    made.table.close()
    signal.signal(signal.SIGTERM, before)


def requested(world: World, hand: Pressing, seconds: float = 1.0) -> WorkerRequest:
    law: ForceLaw = TangentPlane()
    coupling: DirectRendering = Coupling().direct(SCRIPTED, 1.0, 0.01)
    if world.table.has_distances:
        law = DistanceField()
        coupling = Coupling().settled(SCRIPTED, 200.0, 1.0, 0.01)
    shell = flat_tool(6, 0.4 / PITCH * SIZE, np.eye(3))
    slot = SlotRequest(0, world.table.join(), world.grid, shell, coupling)
    alone = DeviceRequest(slot, world.table, hand, Handle(), seconds, staleness=1e9)
    shared = SharedTable.create(1, N_RING)
    return WorkerRequest(shared, Timing(200.0), law, rendering_of(None, law), alone)


def test_loop_withdraws_object_request(world: World) -> None:
    """A whole run: a hand leaves the floor while the database keeps answering."""

    class Leaving(Pressing):
        def apply(self, wrench: Floats) -> None:
            super().apply(wrench)
            world.table.cells.control["heartbeat"] = time.monotonic_ns() + 2 * WITHDRAWN_NS
            if wrench.any():
                self.n_asked = int(world.table.queue.requests["n_asked"].max())
            self.z = -0.004 if 5 < len(self.sent) <= 30 else 0.02

        @property
        def is_over(self) -> bool:
            return len(self.sent) > 120

    hand = Leaving(0.02)
    work(requested(world, hand, seconds=60.0), Heard())
    assert hand.n_asked > 0
    assert not hand.sent[-1].any()
    assert not world.table.queue.requests["n_asked"].any()


def test_loop_held_first_frame_without_hits(world: World) -> None:
    hand = Pressing(-0.004)
    request = requested(world, hand)
    shared = request.shared
    assert request.alone is not None
    clock = PeriodClock(request.law, shared.slots, shared.rings, request.rendering)
    loop = DeviceLoop(request.alone, request.timing, clock)
    loop.warm_up()
    assert (
        loop.tool["felt"]["wrench"].any() or world.table.has_distances
    )  # there the tool lies in the floor
    hand.z = 0.02
    loop._place()
    loop.slot["staleness"] = -(10**18)
    loop.slot["is_frame"] = True
    loop._step(1e-3)
    noted = shared.rings[0, 0]
    assert noted["hits"] == shared.slots["hit_frames"][0] == 0
    assert not noted["applied"].any()


class Ended(SystemExit):
    """Raised by the signal handler of these tests."""


def _end(number: int, _: object) -> None:
    signal.signal(number, signal.SIG_IGN)
    raise Ended


def test_loop_sigterm_releases_device(world: World) -> None:
    class Told(Pressing):
        def apply(self, wrench: Floats) -> None:
            super().apply(wrench)
            if len(self.sent) == 20:
                os.kill(os.getpid(), signal.SIGTERM)

    signal.signal(signal.SIGTERM, _end)
    hand = Told(-0.004)
    with pytest.raises(Ended):
        work(requested(world, hand, seconds=60.0), Heard())
    assert len(hand.sent) < 30
    assert not hand.sent[-1].any()


def test_loop_sigterm_hanging_device_released(world: World) -> None:
    class Hanging(Pressing):
        def read(self) -> Reading:
            if len(self.sent) == 20:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(60.0)
            return super().read()

    signal.signal(signal.SIGTERM, _end)
    hand, started = Hanging(-0.004), time.monotonic()
    with pytest.raises(Ended):
        work(requested(world, hand, seconds=60.0), Heard())
    assert time.monotonic() - started < 50.0
    assert not hand.sent[-1].any()


@pytest.mark.parametrize("when", ["apply", "close"])
def test_loop_sigterm_during_device_close(world: World, when: str) -> None:
    class Told(Pressing):
        is_failing = is_closed = False

        def tell(self, now: str) -> None:
            if self.is_failing and now == when:
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(1e-3)

        def read(self) -> Reading:
            if len(self.sent) > 5:
                self.is_failing = True
                raise DeviceError("unplugged")
            return super().read()

        def apply(self, wrench: Floats) -> None:
            self.tell("apply")
            super().apply(wrench)

        def close(self) -> None:
            self.tell("close")
            self.is_closed = True

    signal.signal(signal.SIGTERM, _end)
    hand = Told(0.02)
    with pytest.raises(DeviceError, match="unplugged"):
        work(requested(world, hand), Heard())
    assert hand.is_closed
    assert not hand.sent[-1].any()
