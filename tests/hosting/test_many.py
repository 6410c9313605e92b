"""Many hosted sessions in one worker: all are served alike, and each is as safe as one alone."""

import os
import signal

import numpy as np

from children import until
from hapticdb import Environment, PointShell
from hapticdb.hosting.host import SessionHost
from hapticdb.recording.frame import State
from hosting.test_host import ABOVE, PRESSED, press, pushed
from realtime.hands import at

RATE = 250.0
"""Frames a second of the tests' sessions."""


def test_sixty_four_sessions_share_a_table_and_all_feel_the_floor(
    env: Environment, sphere: PointShell
) -> None:
    with SessionHost(env.url, rate=RATE, budget_bytes=16 << 20, processes=1) as host:
        sessions = [host.begin(sphere, ABOVE) for _ in range(64)]
        assert len(host.cells) == len(host.pids) == 1
        press(sessions, lambda: all(pushed(session) > 0.5 for session in sessions))
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
        press([session], lambda: pushed(session) > 0.5)
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
