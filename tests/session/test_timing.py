"""Times of a loop, and the settings that `undisturbed` restores."""

import ctypes
import gc
import math
import os
import sys

import numpy as np
import pytest

from hapticdb.errors import UsageError
from hapticdb.kernels.records.session import TIME_BINS
from hapticdb.query.law import DISTANCE, PLANE, ForceLaw
from hapticdb.session.device_loop import empty_loop
from hapticdb.session.report import spread_of
from hapticdb.session.timing import SWITCH_INTERVAL, Timing, undisturbed

GET_TIMERSLACK = 30


def test_spread_of_percentiles_beyond_bins() -> None:
    counts = np.zeros(TIME_BINS + 1, np.int64)
    assert spread_of(counts, 0.0) == (0.0, 0.0, 0.0, 0.0)
    counts[1:1001] = 1
    counts[-1] = 1  # longer than the histogram's bins
    spread = spread_of(counts, 1.0)
    assert spread.p50 == pytest.approx(501e-6, abs=1e-6)
    assert spread.p99 == pytest.approx(991e-6, abs=1e-6)
    assert spread.worst == 1.0


@pytest.mark.parametrize("law", [PLANE, DISTANCE])
def test_empty_loop_duration(law: ForceLaw) -> None:
    figures = empty_loop(law, None, 500.0, 0.1)
    assert 50 <= figures.frames + figures.missed < 60 + figures.missed
    assert figures.seconds >= 0.1
    assert all(map(math.isfinite, (*figures.lateness, *figures.elapsed)))


# -- settings that a loop changes in its process ------------------------------------------------


def slack() -> int:
    return int(ctypes.CDLL(None).prctl(GET_TIMERSLACK, 0, 0, 0, 0))


def settings() -> tuple[object, ...]:
    memory = gc.isenabled(), gc.get_freeze_count()
    system = os.sched_getaffinity(0), slack()
    return (*memory, sys.getswitchinterval(), *system)


@pytest.mark.parametrize("kind", [None, ValueError, KeyboardInterrupt])
def test_undisturbed_restores_settings(kind: type[BaseException] | None) -> None:
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


def test_timing_processor_not_available(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {7, 2, 3})
    for processor in (-1, 5, 10**40):
        with pytest.raises(UsageError, match=r"^processor \S{1,20} is not .* may run on 2, 3, 7$"):
            Timing(processor=processor)
    assert Timing(processor=7).processor == 7
