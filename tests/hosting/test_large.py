"""Hosted sessions of large tools: clusters sleep, broad contacts merge."""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb.realtime.loop
from banded import write_points
from children import until
from hapticdb import Environment, PointShell
from hapticdb.hosting.board import RING
from hapticdb.hosting.host import SessionHost
from hapticdb.hosting.hosted import HostedSession
from hapticdb.hosting.stations import SeatRequest
from hapticdb.kernels.records import pose_numbers
from hapticdb.kernels.resident.cells import WRENCH
from hapticdb.kernels.rigid import poses_of
from hapticdb.query.law import SMOOTH
from hapticdb.realtime.deadlines import Timing
from hapticdb.realtime.drive import MERGES_FROM
from hapticdb.realtime.handle import Handle
from hapticdb.realtime.loop import Loop, LoopRequest, ring_bytes
from hapticdb.recording.file import Recording
from hapticdb.recording.frame import State
from hapticdb.recording.replay import replay
from hapticdb.resident.frames import ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable, anonymous_memory
from realtime.hands import at, still
from realtime.sessions import (
    NEVER_STALE,
    floor_points,
    lying_plate,
    recorded,
    standing_plate,
)
from realtime.worlds import SIZE, make

Floats = NDArray[np.float64]
Frames = NDArray[np.void]
RATE = 100.0
"""Frames a second: periods so long that a busy machine keeps them."""
ABOVE = at(0.0, 0.0, 0.02)


class Ground(NamedTuple):
    """A floor, a host whose cells are all in memory, and the height at which tools touch it."""

    env: Environment
    host: SessionHost
    height: float


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory, sphere: PointShell) -> Iterator[Ground]:
    with make(tmp_path_factory.mktemp("large"), bits=6) as env:
        write_points(env.store, floor_points(31.5), "floor")
        with SessionHost(env.url, rate=RATE, budget_bytes=8 << 20, processes=1) as host:
            host.begin(sphere, ABOVE)  # keeps the cells
            figures = host.cells[0].table.desk.figures
            until(lambda: figures["resident"] + figures["empty"] == 8)
            yield Ground(env, host, 1.0 * SIZE)


def press(session: HostedSession, height: float) -> None:
    """Come down to 3 mm below a height, slide, and leave, as a browser moves a hand."""
    low = height - 0.003
    ways = [(0.0, 0.02), (0.0, low), (0.008, low), (-0.008, low), (-0.008, 0.02)]
    xs, zs = np.array(ways).T
    for share in np.linspace(0.0, 4.0, 50):
        x, z = (np.interp(share, range(5), axis) for axis in (xs, zs))
        session.move(at(float(x), 0.0, float(z)))
        time.sleep(0.03)


def frames_of(ground: Ground, session: HostedSession) -> Frames:
    """All frames of a session from its first one on."""
    board = ground.host._board
    n_frames = int(board.seats["n_frames"][session.seat])
    assert 0 < n_frames < RING
    frames: Frames = board.rings[session.seat, :n_frames].copy()
    return frames


def followed(ground: Ground, asked: SeatRequest, frames: Frames) -> Floats:
    """Poses of the tool, wrenches on hand and tool, and hits of a session of its own (M, 20).

    Its hand is where the hosted session's was, period by period.
    """
    table = ground.host.cells[0].table
    loop = Loop(
        LoopRequest(
            descriptor=os.dup(table.descriptor), n_slots=table.n_slots, row=table.join(),
            ring=anonymous_memory("ring", ring_bytes(8)), n_ring=8, grid=asked.grid,
            shell=asked.shell, device=still(0.02), law=SMOOTH, coupling=asked.coupling,
            handle=Handle(), timing=Timing(RATE), seconds=1.0, staleness=NEVER_STALE,
            is_waiting=False,
        )
    )  # fmt: skip
    tool = pose_numbers(loop.tool)
    tool[:] = asked.pose
    found = []
    for frame in frames:
        pose_numbers(loop.hand)[:] = frame["hand"]
        loop.hand["velocity"] = frame["hand_velocity"]
        loop._step(frame["dt"], is_stale=bool(frame["state"] & State.HELD))
        felt = loop.tool["felt"][WRENCH : WRENCH + 6]
        found.append(np.concatenate([tool, loop.sent.wrench, felt, [loop.sent.hits]]))
    table.leave(loop.row)
    return np.array(found)


@pytest.mark.parametrize("tool", [standing_plate, lying_plate])
def test_a_hosted_session_moves_a_large_tool_as_a_session_of_its_own_does(
    ground: Ground, monkeypatch: pytest.MonkeyPatch, tool: object
) -> None:
    """Bit for bit; without sleep it walks in other strides, which rounding errors tell."""
    assert callable(tool)
    session = ground.host.begin(tool(), ABOVE)
    press(session, ground.height)
    frames, asked = frames_of(ground, session), ground.host._running[session.id].request
    session.end()
    ours = np.column_stack(
        [frames["tool"], frames["applied"], frames["wrench"], frames["hits"]]
    ).astype(np.float64)
    assert not (frames["state"] & State.HELD).any()
    assert frames["applied"].any()
    assert frames["hits"].any()
    own = followed(ground, asked, frames)
    assert ours.tobytes() == own.tobytes()
    monkeypatch.setattr(hapticdb.realtime.loop, "sleeps_by_itself", lambda *_: False)
    awake = followed(ground, asked, frames)
    np.testing.assert_allclose(ours, awake, atol=1e-9)
    if tool is lying_plate:
        assert 1000 < frames["contacts"].max() <= MERGES_FROM < len(asked.shell)


def test_a_recording_has_the_wrenches_of_the_flat_loop_and_replays_bit_for_bit(
    ground: Ground, tmp_path: Path
) -> None:
    plate = standing_plate()
    session = ground.host.begin(plate, ABOVE)
    session.record(tmp_path / "s.hdbrec")
    press(session, ground.height)
    session.end()
    recording, frames = Recording(tmp_path / "s.hdbrec"), recorded(tmp_path / "s.hdbrec")
    poses = np.empty((len(frames), 4, 4))
    poses_of(np.ascontiguousarray(frames["tool"]), poses)
    with CellTable.create(4 << 20, distances=True) as table:
        residency = Residency(ground.env.store, table)
        flat = ResidentFrames(residency, plate, recording.header.law, run=0).feel(poses)
    assert flat.wrenches.tobytes() == np.ascontiguousarray(frames["wrench"]).tobytes()
    assert (flat.hits == frames["hits"]).all()
    assert flat.wrenches.any()
    assert replay(recording, ground.env).is_equal


def test_a_cell_that_changes_beside_a_sleeping_tool_is_felt(ground: Ground, tmp_path: Path) -> None:
    """The tool rests above the floor, all asleep, and something is put where it is."""
    session = ground.host.begin(standing_plate(), ABOVE)
    session.record(tmp_path / "s.hdbrec")  # only recorded frames sleep
    until(lambda: session.figures().frames > 20)
    last = session.latest()
    assert last is not None
    assert last["hits"][0] == 0
    points = np.array([(x, 32.0, 47.0) for x in np.arange(30.0, 34.0, 0.25)])
    added = write_points(ground.env.store, points, "put")
    try:
        until(lambda: (frame := session.latest()) is not None and frame["hits"][0] > 0)
    finally:
        session.end()
        ground.env.remove(added)
