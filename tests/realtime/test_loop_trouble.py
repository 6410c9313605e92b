"""The loop, frame by frame, when cells are lost, the hand leaves, or its process must end."""

import io
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from banded import write_points
from feel.tools import flat_tool
from hapticdb import Grid, TangentPlane
from hapticdb.devices.profiles import SCRIPTED
from hapticdb.devices.protocol import Reading
from hapticdb.errors import DeviceError
from hapticdb.kernels.hand.holding import RISE_FRAMES
from hapticdb.kernels.period.loop import ALWAYS, WITHDRAWN_NS
from hapticdb.kernels.resident.cells import BUFFERS, VERSION, Cells
from hapticdb.query.law import DistanceField, ForceLaw
from hapticdb.realtime import loop as subject
from hapticdb.realtime.board import Board
from hapticdb.realtime.coupling import Coupling, DirectRendering, SettledCoupling
from hapticdb.realtime.deadlines import Timing
from hapticdb.realtime.handle import Handle
from hapticdb.realtime.loop import Loop, LoopRequest, work
from hapticdb.realtime.processes import MessageSender
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import HEARTBEAT, CellTable
from hapticdb.testing import write_voxels
from realtime.hands import at
from realtime.sessions import floor_points
from realtime.worlds import block, cells_of

Floats = NDArray[np.float64]
SIZE = 0.005
"""Voxel size in metres."""
BITS = 6
SIDE = 1 << BITS
N_RING = 64
MIDDLE = SIDE // 2
FLOOR = block((MIDDLE - 12, MIDDLE - 12, MIDDLE - 4), (MIDDLE + 11, MIDDLE + 11, MIDDLE - 1))
LATE = 10 * 10**9
"""Longest wait of a frame in ns: so long that no test reaches it."""


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


@pytest.fixture(params=["plane", "smooth"])
def world(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    """A floor that is felt directly, or through the coupling."""
    monkeypatch.setattr(subject, "parent_is_gone", lambda: False)  # standard input may be closed
    monkeypatch.setattr(subject, "WARM_PATIENCE", 0.0)  # no fetching process exists
    before = signal.getsignal(signal.SIGTERM)
    made = World(has_distances=request.param == "smooth")
    yield made
    made.table.close()
    signal.signal(signal.SIGTERM, before)


def requested(world: World, hand: Pressing, **options: object) -> LoopRequest:
    hold = float(str(options.pop("hold", 0.02)))
    law: ForceLaw = TangentPlane()
    coupling: DirectRendering | SettledCoupling = Coupling().direct(SCRIPTED, 1.0, 0.01)
    if world.table.has_distances:
        law = DistanceField()
        coupling = Coupling().settled(SCRIPTED, 200.0, 1.0, 0.01)
    given: dict[str, object] = {"is_waiting": True, "seconds": 1.0}
    return LoopRequest(
        descriptor=world.table.descriptor,
        n_slots=world.table.n_slots,
        row=world.table.join(),
        board=Board.create(1, N_RING).descriptor,
        n_ring=N_RING,
        grid=world.grid,
        shell=flat_tool(6, SIZE, np.eye(3), pitch=0.4),
        device=hand,
        law=law,
        coupling=replace(coupling, hold=hold),
        handle=Handle(),
        timing=Timing(200.0),
        staleness=1e9,
        **(given | options),  # type: ignore[arg-type]
    )


def frame(loop: Loop, hand: Pressing, dt: float = 1e-3) -> None:
    """Run one frame that waits for its cells."""
    loop._take(hand.read())
    now = time.perf_counter_ns()
    loop._step_exactly(dt, now + LATE, now, now)
    hand.apply(loop.sent.wrench)


def pressed(world: World, hand: Pressing, **options: object) -> Loop:
    """A loop whose tool was placed in the air and then pressed on the floor."""
    loop = Loop(requested(world, hand, **options))
    loop.warm_up()
    loop._place()
    hand.z = -0.01
    for _ in range(300):
        frame(loop, hand)
    assert loop.sent.wrench[2] > 1.0
    return loop


class Summoning(Pressing):
    """A hand without cells: 3 reads after its force is zero it moves, and the cells return."""

    def __init__(self, z: float) -> None:
        super().__init__(z)
        self.keys: NDArray[np.int64] | None = None
        self.known: NDArray[np.int64] | None = None
        self.reads_left = 1 << 30

    def take(self, cells: Cells) -> None:
        """Make all cells unknown, in a new version of the same directory."""
        self.keys, self.known = cells.keys, cells.keys.copy()
        cells.keys[:] = -1
        cells.control[VERSION] += BUFFERS

    def apply(self, wrench: Floats) -> None:
        super().apply(wrench)
        if self.keys is not None and not wrench.any():
            self.reads_left = 3

    def read(self) -> Reading:
        self.reads_left -= 1
        if self.reads_left == 0 and self.keys is not None and self.known is not None:
            self.keys[:] = self.known
            self.buttons, self.z = 2, -0.02
        return super().read()


def test_after_a_wait_that_let_go_the_force_rises_from_nothing(world: World) -> None:
    """No frame raises the force by more than one share, even a frame as long as the wait."""
    hand = Summoning(0.02)
    loop = pressed(world, hand, hold=1e-3)
    full, n_before = loop.sent.wrench[2], len(hand.sent)
    hand.take(world.table.cells)
    frame(loop, hand)
    for dt in [0.3] + [1e-3] * 20:
        frame(loop, hand, dt)
    sent = [float(wrench[2]) for wrench in hand.sent[n_before:]]
    assert sent[0] == 0.0
    assert sent[1] == pytest.approx(full / 20, rel=0.1)
    assert max(np.diff(sent)) <= full / RISE_FRAMES * 1.01
    assert sent[-1] == pytest.approx(full, rel=0.01)


def test_after_a_wait_that_let_go_it_counts_where_the_hand_is_by_then(
    world: World,
) -> None:
    """The reading that the frame used is the one that is recorded."""
    hand = Summoning(0.02)
    loop = pressed(world, hand, hold=1e-3)
    hand.take(world.table.cells)
    frame(loop, hand)
    assert not loop.sent.unknown
    noted = loop.board.last_frame(0)
    assert noted is not None
    assert noted["buttons"][0] == 2
    assert noted["hand"][0, 2] == loop.hand["position"][2] == -0.02


def test_a_frame_that_waits_lets_go_and_ends_with_the_session(world: World) -> None:
    class Lost(Summoning):
        def apply(self, wrench: Floats) -> None:
            super().apply(wrench)
            self.reads_left = 1 << 30  # the cells stay away
            self.z = -0.01 if len(self.sent) > 5 else 0.02  # it begins in the air
            if len(self.sent) == 50:
                self.take(world.table.cells)

    hand = Lost(0.02)
    request = requested(world, hand, seconds=0.5)
    board = Board(os.dup(request.board), N_RING)
    work(request, MessageSender(io.BytesIO()))
    assert board.seats["unknown_frames"][0] == 1
    assert hand.sent[-5].any()
    assert not np.any(hand.sent[-4:])  # one during the wait, one of that frame, two at the end


def test_a_loop_takes_back_what_it_asked_for(world: World) -> None:
    """A whole run: a hand leaves the floor while the database keeps answering."""

    class Leaving(Pressing):
        def apply(self, wrench: Floats) -> None:
            super().apply(wrench)
            world.table.cells.control[HEARTBEAT] = time.monotonic_ns() + 2 * WITHDRAWN_NS
            if wrench.any():
                self.n_asked = int(world.table.desk.sessions["n_asked"].max())
            self.z = -0.004 if 5 < len(self.sent) <= 30 else 0.02

        @property
        def is_over(self) -> bool:
            return len(self.sent) > 120

    hand = Leaving(0.02)
    work(requested(world, hand, is_waiting=False, seconds=60.0), MessageSender(io.BytesIO()))
    assert hand.n_asked > 0
    assert not hand.sent[-1].any()
    assert not world.table.desk.sessions["n_asked"].any()


def test_a_first_frame_that_is_held_has_no_hits_of_the_warm_up(world: World) -> None:
    hand = Pressing(-0.004)
    loop = Loop(requested(world, hand))
    loop.warm_up()
    assert loop.tool["felt"].any()
    hand.z = 0.02
    loop._place()
    loop.station.row["staleness"] = -(10**18)
    loop._step(1e-3, ALWAYS)
    noted = loop.board.rings[0, 0]
    assert noted["hits"] == loop.board.seats["hit_frames"][0] == 0
    assert not noted["wrench"].any()


@pytest.mark.parametrize("when", ["apply", "close"])
def test_a_process_told_to_end_while_it_gives_its_device_back_does_so_first(
    world: World, when: str
) -> None:
    class Ended(SystemExit):
        pass

    def end(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_IGN)
        raise Ended

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

    signal.signal(signal.SIGTERM, end)
    hand = Told(0.02)
    with pytest.raises(DeviceError, match="unplugged"):
        work(requested(world, hand), MessageSender(io.BytesIO()))
    assert hand.is_closed
    assert not hand.sent[-1].any()
