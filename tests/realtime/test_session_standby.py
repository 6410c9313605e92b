"""A session whose cells come from a standby feels nothing that is older than its staleness."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import contextlib
import itertools
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psycopg
import pytest

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.realtime.session import Session
from hapticdb.recording.frame import State
from hapticdb.testing import floor_voxels
from realtime.hands import still
from realtime.sessions import RATE, floored, recorded, until
from realtime.worlds import SIZE, move
from standbys import Pair, pair  # noqa: F401 - a fixture

GRID = Grid(SIZE, (-32 * SIZE,) * 3, 6)
HEIGHT_M = 0.010
"""Height of a hand whose tool presses 2 mm into the floor."""
STALENESS_S = 0.6
FALL_S = 0.04
"""Seconds in which a force falls to zero once all cells count as unknown."""
SPARE_S = 0.05
"""Seconds by which this test may misjudge when a session has begun."""
UP = floor_voxels(GRID, width=48)
DOWN = UP - np.array([0, 0, 3])
numbers = itertools.count()


class Clock:
    """Knows when a session's frames began, by the clock of this process: no earlier than told."""

    def __init__(self) -> None:
        self.began = np.inf

    def look(self, session: Session) -> None:
        last = session.last()
        if last is not None:
            self.began = min(self.began, time.monotonic() - float(last["time"][0]))


@pytest.fixture
def name() -> str:
    return f"session_{next(numbers)}"


@pytest.fixture
def env(pair: Pair, name: str) -> Iterator[Environment]:
    """The environment on the primary, a floor that the standby has, too."""
    with floored(hapticdb.create(pair.at_primary(name), GRID, layout="brick")) as made:
        pair.await_replay()
        yield made


def force(session: Session) -> float:
    last = session.last()
    return 0.0 if last is None else float(np.linalg.norm(last["applied"][0]))


def is_fading(session: Session) -> bool:
    last = session.last()
    return last is not None and bool(last["state"][0] & State.FADING)


def revision(session: Session) -> int:
    last = session.last()
    return -1 if last is None else int(last["revision"][0])


def test_a_standby_that_lags_takes_the_force_away_in_time_and_gives_it_back(
    pair: Pair, name: str, env: Environment, sphere: PointShell, tmp_path: Path
) -> None:
    path, clock = tmp_path / "lagging.hdbrec", Clock()
    with (
        ResidentCells(pair.url(name), budget_bytes=1 << 20) as cells,
        Session(
            cells,
            sphere,
            still(HEIGHT_M),
            law="plane",
            rate=RATE,
            staleness=STALENESS_S,
            record=path,
        ) as session,
    ):
        until(lambda: force(session) > 0 and not is_fading(session), session)
        first = revision(session)
        with pair.paused():
            # no write, no age: the force stays although nothing is replayed
            ends = time.monotonic() + 2 * STALENESS_S
            while time.monotonic() < ends:
                session.wait(0.02)
                clock.look(session)
            assert force(session) > 0
            assert not is_fading(session)
            move(env.store, 1, DOWN)
            committed = time.monotonic()
            until(lambda: is_fading(session) and not force(session), session)
            assert revision(session) == first
            until(lambda: cells.is_away, session)
            until(lambda: time.monotonic() > committed + 3 * STALENESS_S, session)
            resumed = time.monotonic()
        until(lambda: revision(session) == first + 1 and not is_fading(session), session)
        assert not force(session)
        until(lambda: not cells.is_away, session)
        move(env.store, 1, UP)
        until(lambda: force(session) > 0 and not is_fading(session), session)
        session.stop()
    frames = recorded(path)
    began = clock.began + frames["time"]
    is_old = (frames["revision"] == first) & frames["applied"].any(axis=1)
    assert is_old.any()
    assert began[is_old].max() < committed + STALENESS_S + FALL_S + SPARE_S
    is_late = (began > committed + STALENESS_S + FALL_S + SPARE_S) & (began < resumed)
    assert is_late.any()
    assert not frames["applied"][is_late].any()


def test_an_edit_on_the_primary_is_felt_through_the_standby(
    pair: Pair, name: str, env: Environment, sphere: PointShell, tmp_path: Path
) -> None:
    path = tmp_path / "edited.hdbrec"
    with Session(
        pair.url(name), sphere, still(HEIGHT_M), law="plane", rate=RATE, staleness=60.0,
        record=path, budget_bytes=1 << 20,
    ) as session:  # fmt: skip
        until(lambda: force(session) > 0, session)
        move(env.store, 1, DOWN)
        until(lambda: not force(session), session)
        assert not is_fading(session)
        move(env.store, 1, UP)
        until(lambda: force(session) > 0, session)
        report = session.stop()
    assert report.stale_frames == 0


def test_a_session_on_a_standby_whose_primary_is_not_named_is_refused(
    pair: Pair, name: str, env: Environment
) -> None:
    assert env.objects()
    with pytest.raises(hapticdb.StaleError, match="name the primary in the URL") as told:
        ResidentCells(pair.url(name, pair.standby), budget_bytes=1 << 20)
    assert "\n" not in str(told.value)


@pytest.mark.long
def test_a_primary_that_is_lost_takes_the_force_away_until_it_is_back(
    pair: Pair, name: str, env: Environment, sphere: PointShell
) -> None:
    env.close()
    with (
        ResidentCells(pair.url(name), budget_bytes=1 << 20) as cells,
        Session(
            cells, sphere, still(HEIGHT_M), law="plane", rate=RATE, staleness=STALENESS_S
        ) as session,
    ):
        until(lambda: force(session) > 0 and not is_fading(session), session)
        pair.primary.kill()
        try:
            until(lambda: is_fading(session) and not force(session), session)
            assert cells.figures().losses == 0  # the standby answers as before
        finally:
            pair.primary.start()
        until(lambda: force(session) > 0 and not is_fading(session), session)


@pytest.mark.long
def test_a_standby_that_is_lost_is_replaced_by_the_primary(
    pair: Pair, name: str, env: Environment, sphere: PointShell
) -> None:
    with (
        ResidentCells(pair.url(name), budget_bytes=1 << 20) as cells,
        Session(
            cells, sphere, still(HEIGHT_M), law="plane", rate=RATE, staleness=STALENESS_S
        ) as session,
    ):
        until(lambda: force(session) > 0 and not is_fading(session), session)
        pair.standby.kill()
        try:
            move(env.store, 1, DOWN)
            until(lambda: revision(session) == 2 and not is_fading(session), session)
            assert not force(session)
            move(env.store, 1, UP)
            until(lambda: force(session) > 0, session)
        finally:
            with contextlib.suppress(psycopg.Error):
                pair.standby.start()
