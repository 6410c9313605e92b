"""Timing in turns: each alternative runs every pose once, interleaved; summary of the times."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.bench import measure
from hapticdb.bench.measure import CHUNK, Alternative, Pose, in_turns, summary
from hapticdb.query.frame import Query

POSES = np.tile(np.eye(4), (5 * CHUNK + 3, 1, 1))
POSES[:, 0, 3] = np.arange(len(POSES))


def counting(log: list[tuple[str, int]], name: str) -> Callable[[Pose], Query]:
    """A frame that only logs the pose it gets."""

    def frame(pose: Pose) -> Query:
        log.append((name, int(pose[0, 3])))
        return Query("array", 1, 2, 7, 0.0)

    return frame


@given(st.integers(1, 9))
def test_every_alternative_measures_every_pose_once(count: int) -> None:
    log: list[tuple[str, int]] = []
    alternatives = [Alternative({"n": n}, counting(log, str(n))) for n in range(count)]
    cells = in_turns(alternatives, POSES, limit_s=60.0, warm=0)
    for n, (alternative, cell) in enumerate(zip(alternatives, cells, strict=True)):
        assert sorted(alternative.poses) == list(range(len(POSES)))
        assert {pose for name, pose in log if name == str(n)} == set(range(len(POSES)))
        assert (cell["n"], cell["frames"], cell["cut_short"]) == (n, len(POSES), False)
        assert (cell["ranges"], cell["rows"]) == (2.0, 7.0)


def test_no_alternative_follows_another_over_the_same_poses() -> None:
    """Otherwise the second would find in the cache the pages that the first has read."""
    log: list[tuple[str, int]] = []
    alternatives = [Alternative({}, counting(log, name)) for name in "abc"]
    in_turns(alternatives, POSES, limit_s=60.0, warm=0)
    runs = [
        {pose for _, pose in frames} for _, frames in itertools.groupby(log, lambda one: one[0])
    ]
    for before, after in itertools.pairwise(runs):
        assert len(before & after) <= 1 or len(before) > CHUNK + 1


def test_the_frame_before_a_turn_is_not_timed() -> None:
    log: list[tuple[str, int]] = []
    (cell,) = in_turns([Alternative({}, counting(log, "a"))], POSES, limit_s=60.0, warm=0)
    n_turns = -(-len(POSES) // CHUNK)
    assert len(log) == len(POSES) + n_turns
    assert cell["frames"] == len(POSES)


class Clock:
    """A clock that only a test moves."""

    def __init__(self) -> None:
        self.now_ns = 0

    def perf_counter_ns(self) -> int:
        return self.now_ns

    def perf_counter(self) -> float:
        return self.now_ns / 1e9

    def passes(self, ms: int) -> None:
        self.now_ns += ms * 1_000_000


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(measure, "time", found)
    return found


def test_a_slow_alternative_is_stopped_and_says_so(clock: Clock) -> None:
    def slow(_: Pose) -> Query:
        clock.passes(5)
        return Query("array", 1, 1, 1, 0.0)

    quick = counting([], "quick")
    cells = in_turns([Alternative({}, slow), Alternative({}, quick)], POSES, limit_s=0.02, warm=0)
    assert cells[0]["cut_short"]
    assert cells[0]["frames"] == 5  # the fifth frame is over the limit
    assert not cells[1]["cut_short"]


def test_false_rows_are_those_beyond_what_the_same_poses_ask_for() -> None:
    asked = [n % 5 for n in range(len(POSES))]
    (cell,) = in_turns([Alternative({}, counting([], "a"))], POSES, limit_s=60.0, asked_rows=asked)
    assert cell["false_rows"] == pytest.approx(7 - np.mean(asked))


def test_what_comes_before_a_frame_is_not_part_of_its_time(clock: Clock) -> None:
    def frame(_: Pose) -> Query:
        clock.passes(1)
        return Query("array", 1, 1, 1, 0.0)

    alternative = Alternative({}, frame, before=lambda: clock.passes(10))
    in_turns([alternative], POSES[:5], limit_s=60.0, warm=0)
    assert alternative.times_us == [1000.0] * 5


def test_what_auto_chose_is_counted() -> None:
    (cell,) = in_turns([Alternative({"strategy": "auto"}, counting([], "a"))], POSES, limit_s=60.0)
    assert cell["chosen"] == {"array": len(POSES)}


@given(st.lists(st.floats(1, 1e6), min_size=1, max_size=300))
def test_the_summary_is_ordered_and_its_typical_frame_lies_within(times: list[float]) -> None:
    found = summary(times)
    shares = [found[name] for name in ("p10", "p50", "p90", "p99", "max")]
    numbers = [us for us in shares if us is not None]
    assert len(numbers) == 5
    assert numbers == sorted(numbers)
    assert found["max"] == max(times)
    assert found["mean"] == pytest.approx(math.fsum(times) / len(times))
    assert found["typical"] is not None
    assert min(times) <= found["typical"] * (1 + 1e-12)
    assert found["typical"] <= max(times) * (1 + 1e-12)


def test_typical_leaves_out_a_twentieth_at_either_end() -> None:
    times = [1e9, 1e9, *[10.0] * 36, 0.0, 0.0]
    assert summary(times)["typical"] == 10.0


def test_the_slowest_in_a_thousand_needs_ten_thousand_frames() -> None:
    assert summary(np.arange(9999))["p99.9"] is None
    assert summary(np.arange(10_000))["p99.9"] == pytest.approx(np.percentile(range(10_000), 99.9))
    assert summary([])["p50"] is None
