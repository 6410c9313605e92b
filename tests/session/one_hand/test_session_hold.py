"""Without an answer a session holds its force for a while, and then lets it fall to zero."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticdb import Environment, PointShell
from hapticdb.devices.scripted import Player
from hapticdb.recording.file import Recording
from hapticdb.recording.frame import State
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.replay import replay
from hapticdb.session.session import Session
from session.hands import Beckoned, at, still
from session.sessions import NEVER_STALE, RATE, Recorded, recorded, until
from session.worlds import block, make
from voxels import write_voxels


def held_for(frames: Recorded) -> NDArray[np.float64]:
    """Seconds for which each frame's wrench had been held, by the coupling's own periods."""
    out, kept = np.zeros(len(frames)), 0.0
    for n, frame in enumerate(frames):
        kept = kept + max(float(frame["dt"]), 0.0) if frame["state"] & State.HELD else 0.0
        out[n] = kept
    return out


def check_falling(frames: Recorded) -> None:
    """Check held wrenches: unchanged for 20 ms, zero from 40 ms on, never growing in between."""
    seconds = held_for(frames)
    sizes = np.linalg.norm(frames["applied"], axis=1)
    kept = np.zeros(6)
    for n, frame in enumerate(frames):
        if seconds[n] == 0.0:
            kept = frame["applied"]
        elif seconds[n] <= 0.02:
            np.testing.assert_array_equal(frame["applied"], kept)
        elif seconds[n] >= 0.04:
            assert not frame["applied"].any()
        else:
            assert sizes[n] <= sizes[n - 1]


@pytest.mark.long
def test_session_killed_prefetch_process_restarts(
    voxel_floor: Environment, sphere: PointShell, tmp_path: Path
) -> None:
    path = tmp_path / "killed.hdbrec"
    with (
        ResidentCells(voxel_floor.url, budget_bytes=1 << 20) as cells,
        Session(
            cells, sphere, still(0.010), law="plane", rate=RATE, staleness=0.2, record=path
        ) as session,
    ):
        until(lambda: session.n_frames > 50, session)
        killed = cells.pid
        os.kill(killed, signal.SIGSTOP)  # a new process would be there before the force fades

        def is_fading() -> bool:
            last = session.last()
            return last is not None and bool(last["state"][0] & State.FADING)

        until(is_fading, session)
        os.kill(killed, signal.SIGKILL)
        until(lambda: not is_fading() and cells.pid != killed, session)
        n_frames = session.n_frames
        until(lambda: session.n_frames > n_frames + 50, session)
        report = session.stop()
    assert report.cache.restarts == 1
    assert report.stale_frames > 0
    frames = recorded(path)
    check_falling(frames)
    is_silent = frames["state"] & State.FADING > 0
    assert not frames["applied"][is_silent][-1].any()
    last = np.flatnonzero(is_silent)[-1]
    is_held = frames["state"] & State.HELD > 0
    assert frames["applied"][~is_held][:50].any(axis=1).all()
    assert frames["applied"][last + 1 :].any(axis=1).any()
    assert replay(Recording(path), voxel_floor).is_equal


def test_session_unknown_cells_hold_and_fade(sphere: PointShell, tmp_path: Path) -> None:
    """The prefetch process is stopped while the hand moves far."""
    path = Player([0.0, 0.4, 3600.0], [at(x, 0.0, 0.010) for x in (-0.45, 0.45, 0.45)])
    hand = Beckoned(path, tmp_path / "come")
    with make(tmp_path, bits=9) as env:
        write_voxels(env.store, block((0, 240, 248), (511, 271, 255)), "floor, 1 m long")
        with ResidentCells(env.url, budget_bytes=4 << 20) as cells:
            session = Session(
                cells, sphere, hand, law="plane", rate=RATE, record=tmp_path / "a",
                staleness=NEVER_STALE,
            )  # fmt: skip
            with session:
                until(lambda: session.n_frames > 100, session)
                os.kill(cells.pid, signal.SIGSTOP)
                try:
                    hand.path.touch()
                    until(lambda: is_unknown(session) and not is_pushed(session), session)
                finally:
                    os.kill(cells.pid, signal.SIGCONT)
                until(lambda: not is_unknown(session) and is_pushed(session), session)
                report = session.stop()
    frames = recorded(tmp_path / "a")
    assert report.held_frames == np.count_nonzero(frames["state"] & State.HELD)
    check_falling(frames)
    unknown = frames[frames["unknown"] > 0]
    assert len(unknown)
    assert (unknown["state"] & State.HELD > 0).all()
    assert held_for(frames).max() > 0.04
    assert frames["applied"][-1].any()


def is_unknown(session: Session) -> bool:
    last = session.last()
    return last is not None and bool(last["unknown"][0])


def is_pushed(session: Session) -> bool:
    last = session.last()
    return last is not None and bool(last["applied"].any())
