"""Many hosted sessions in one worker: all are served alike, and each is as safe as one alone."""

import os
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest

from banded import write_points
from children import PATIENCE, until
from hapticdb import Environment, PointShell
from hapticdb.hosting.host import SessionHost
from hapticdb.hosting.hosted import HostedSession
from hapticdb.recording.frame import State
from realtime.hands import at
from realtime.sessions import floor_points
from realtime.worlds import make

RATE = 250.0
"""Frames a second of the tests' sessions."""
ABOVE, PRESSED = at(0.0, 0.0, 0.02), at(0.0, 0.0, 0.004)
"""Poses of the ball of 12 mm: over the floor at z = 0, and pressed into it."""


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    """A floor just under z = 0, with distances."""
    with make(tmp_path_factory.mktemp("many"), bits=6) as made:
        write_points(made.store, floor_points(31.5), "floor")
        yield made


def pushed(session: HostedSession) -> float:
    """Force along z that the hand feels now, N."""
    last = session.latest()
    return 0.0 if last is None else float(last["applied"][0, 2])


def test_sixty_four_sessions_share_a_table_and_all_feel_the_floor(
    env: Environment, sphere: PointShell
) -> None:
    with SessionHost(env.url, rate=RATE, budget_bytes=16 << 20, processes=1) as host:
        sessions = [host.begin(sphere, ABOVE) for _ in range(64)]
        assert len(host.cells) == len(host.pids) == 1
        deadline = time.monotonic() + PATIENCE
        while not all(pushed(session) > 0.5 for session in sessions):
            assert time.monotonic() < deadline
            for session in sessions:
                session.move(PRESSED)
            time.sleep(0.03)
        for session in sessions[::2]:
            session.end()
        assert [one.id for one in host.sessions()] == [one.id for one in sessions[1::2]]
        assert all(pushed(session) > 0.5 for session in sessions[1::2])
        again = [host.begin(sphere, ABOVE) for _ in range(32)]  # their rows are free again
        until(lambda: all(session.latest() is not None for session in again))


def test_an_overloaded_worker_runs_all_sessions_at_the_same_lower_rate(
    env: Environment, sphere: PointShell
) -> None:
    with SessionHost(env.url, rate=20_000.0, budget_bytes=16 << 20, processes=1) as host:
        sessions = [host.begin(sphere, PRESSED) for _ in range(24)]
        before = [session.figures() for session in sessions]
        until(lambda: sessions[-1].figures().frames > before[-1].frames + 2000)
        after = [session.figures() for session in sessions]
        frames = np.array([b.frames - a.frames for a, b in zip(before, after, strict=True)])
        assert frames.max() - frames.min() < 0.2 * frames.max()
        assert all(one.missed > 0 for one in after)
        assert all(one.in_time < 0.9 for one in after)


def test_a_database_that_does_not_answer_lets_the_force_fall_until_it_does(
    env: Environment, sphere: PointShell
) -> None:
    with SessionHost(env.url, rate=RATE, budget_bytes=16 << 20) as host:
        session = host.begin(sphere, ABOVE)
        deadline = time.monotonic() + PATIENCE
        while pushed(session) < 0.5:
            assert time.monotonic() < deadline
            session.move(PRESSED)
            time.sleep(0.03)
        fetching = host.cells[0].pid
        os.kill(fetching, signal.SIGSTOP)
        try:
            until(lambda: pushed(session) == 0.0)
            last = session.latest()
            assert last is not None
            assert last["state"][0] & State.HELD
            assert session.figures().stale > 0
        finally:
            os.kill(fetching, signal.SIGCONT)
        until(lambda: pushed(session) > 0.5)


def test_a_tool_in_cells_that_are_not_resident_is_not_pushed(
    env: Environment, sphere: PointShell
) -> None:
    with SessionHost(env.url, rate=RATE, budget_bytes=16 << 20) as host:
        near = host.begin(sphere, ABOVE)
        until(lambda: near.latest() is not None)
        os.kill(host.cells[0].pid, signal.SIGSTOP)  # nothing is fetched any more
        try:
            far = host.begin(sphere, at(5.0, 5.0, 5.0))
            until(lambda: far.latest() is not None)
            assert not far.latest()["applied"].any()  # type: ignore[index]
        finally:
            os.kill(host.cells[0].pid, signal.SIGCONT)
