"""Deadlines on a clock that the test moves, and the settings that `undisturbed` restores."""

import ctypes
import gc
import math
import os
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.errors import UsageError
from hapticdb.realtime.deadlines import (
    SWITCH_INTERVAL,
    Deadlines,
    Timing,
    empty_loop,
    undisturbed,
)
from hapticdb.realtime.report import Times

PERIOD = 1_000_000
GET_TIMERSLACK = 30


class Clock:
    """A clock in nanoseconds: reading it takes 50 ns, a sleep ends `late` ns too late."""

    def __init__(self, start: int = 12_345) -> None:
        self.now = start
        self.late = 0

    def __call__(self) -> int:
        self.now += 50
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += round(seconds * 1e9) + self.late


def ticking() -> tuple[Clock, Deadlines]:
    clock = Clock()
    return clock, Deadlines(PERIOD, Times(), Times(), clock=clock, sleep=clock.sleep)


@given(st.lists(st.integers(0, 5 * PERIOD), min_size=1, max_size=50))
def test_every_frame_begins_at_a_deadline_and_all_others_are_missed(works: list[int]) -> None:
    clock, deadlines = ticking()
    for work in works:
        begun = deadlines.wait()
        assert 0 <= begun - deadlines.due < 200
        assert (deadlines.due - deadlines.started) % PERIOD == 0
        clock.now += work
        deadlines.done()
    figures = deadlines.figures()
    assert figures.frames == len(works)
    assert deadlines.passed == figures.frames + figures.missed
    assert deadlines.passed * PERIOD == deadlines.due - PERIOD - deadlines.started
    assert (deadlines.passed - 1) * PERIOD <= figures.seconds * 1e9 + 1
    assert figures.seconds * 1e9 <= (deadlines.passed + 1) * PERIOD


def test_a_frame_of_two_and_a_half_periods_misses_two_deadlines() -> None:
    clock, deadlines = ticking()
    deadlines.wait()
    clock.now += 5 * PERIOD // 2
    deadlines.done()
    deadlines.wait()
    assert deadlines.missed == 2
    assert deadlines.dt == pytest.approx(3e-3, abs=1e-6)
    assert deadlines.figures().elapsed.worst == pytest.approx(2.5e-3, abs=1e-6)


def test_a_late_wake_up_is_lateness_and_no_drift() -> None:
    clock, deadlines = ticking()
    clock.late = 300_000
    for _ in range(100):
        begun = deadlines.wait()
        assert (begun - deadlines.due) == pytest.approx(240_000, abs=200)  # 60 us were to spin
        deadlines.done()
    assert deadlines.missed == 0
    assert deadlines.due - deadlines.started == 101 * PERIOD
    assert deadlines.figures().lateness.p50 == pytest.approx(240e-6, abs=1e-6)


def test_percentiles_are_of_all_that_was_counted() -> None:
    times = Times()
    assert times.spread() == (0.0, 0.0, 0.0, 0.0)
    for n in range(1, 1001):
        times.add(n * 1e-6)
    times.add(1.0)  # beyond the histogram's last bin
    spread = times.spread()
    assert spread.p50 == pytest.approx(501e-6, abs=1e-6)
    assert spread.p99 == pytest.approx(991e-6, abs=1e-6)
    assert spread.worst == 1.0


def test_an_empty_loop_lasts_as_many_deadlines_as_asked() -> None:
    figures = empty_loop(500.0, 0.1)
    assert 50 <= figures.frames + figures.missed < 60 + figures.missed
    assert all(map(math.isfinite, (*figures.lateness, *figures.elapsed)))


# -- settings that a loop changes in its process ------------------------------------------------


def slack() -> int:
    return int(ctypes.CDLL(None).prctl(GET_TIMERSLACK, 0, 0, 0, 0))


def settings() -> tuple[object, ...]:
    memory = gc.isenabled(), gc.get_freeze_count()
    system = os.sched_getaffinity(0), slack()
    return (*memory, sys.getswitchinterval(), *system)


@pytest.mark.parametrize("kind", [None, ValueError, KeyboardInterrupt])
def test_all_is_as_before_afterwards(kind: type[BaseException] | None) -> None:
    processor = min(os.sched_getaffinity(0))
    before = settings()
    try:
        with undisturbed(processor):
            assert not gc.isenabled()
            assert gc.get_freeze_count() > 0
            assert sys.getswitchinterval() == pytest.approx(SWITCH_INTERVAL)
            assert os.sched_getaffinity(0) == {processor}
            assert slack() == 1
            if kind:
                raise kind
    except (ValueError, KeyboardInterrupt):
        assert kind is not None
    assert settings() == before


def test_a_processor_that_is_not_granted_is_refused_and_the_others_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {7, 2, 3})
    for processor in (-1, 5, 10**40):
        with pytest.raises(UsageError, match=r"^processor \S{1,20} is not .* may run on 2, 3, 7$"):
            Timing(processor=processor)
    assert Timing(processor=7).processor == 7
