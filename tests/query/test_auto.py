"""The strategy `auto`: the model's choice, corrected by what frames took."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from hapticdb.query.auto import FEW, LONG, MOST_KEPT, TRY_EVERY, Choice, Chooser
from hapticdb.query.cost_model import CostModel
from hapticdb.query.quantiles import QuantileVector

KEYS = np.arange(0, 4000, 40, dtype=np.int64)
QUANTILES = QuantileVector(np.arange(0, 4001, 100, dtype=np.int64), 400)
# of keys 110 us, of ranges 100 + 10 a range, of points 1000, Figure 3 never
MODEL = CostModel(
    statement=100.0,
    descent=10.0,
    block=0.0,
    row=0.1,
    rows_per_block=100.0,
    lookup=100.0,
    probe=0.1,
    single=10.0,
    aggregate=1e6,
    point=1.0,
)


def run(
    chooser: Chooser, took: dict[str, float], frames: int, rows: int | None = None
) -> Counter[str]:
    """Frames whose strategies take so many microseconds; what was chosen."""
    chosen: Counter[str] = Counter()
    for _ in range(frames):
        kept = chooser.kept(len(KEYS))
        if kept is None:
            choice = chooser.choose(300, KEYS)
            kept = choice.strategy
            chooser.find(choice, round(choice.rows) if rows is None else rows)
        elif chooser.is_listening:
            ranges, expected = (1, 400) if kept == "cbgroup" else (len(KEYS), 10)
            read = expected if rows is None else rows
            chooser.hear(Choice(kept, 300, len(KEYS), ranges, read), took[kept])
        chosen[kept] += 1
    return chosen


def test_the_first_frame_follows_the_model() -> None:
    array_is_cheap = replace(MODEL, statement=500.0)
    assert Chooser(QUANTILES, array_is_cheap).choose(300, KEYS).strategy == "array"
    keys_are_dear = replace(MODEL, lookup=500.0)
    assert Chooser(QUANTILES, keys_are_dear).choose(300, KEYS).strategy == "cbgroup"
    points_are_cheap = replace(MODEL, single=0.1)
    assert Chooser(QUANTILES, points_are_cheap).choose(300, KEYS).strategy == "points"
    figure_3_is_cheap = replace(MODEL, aggregate=1.0, point=0.01)
    assert Chooser(QUANTILES, figure_3_is_cheap).choose(300, KEYS).strategy == "statement"


@pytest.mark.parametrize("faster", ["array", "cbgroup"])
def test_a_model_that_is_wrong_by_half_is_corrected_by_what_frames_take(faster: str) -> None:
    took = {"array": 150.0, "cbgroup": 150.0, "points": 1000.0}
    took[faster] = 80.0
    chooser = Chooser(QUANTILES, MODEL)
    run(chooser, took, 10 * MOST_KEPT)
    assert run(chooser, took, 400)[faster] > 370


def test_the_choice_follows_when_what_frames_take_changes() -> None:
    chooser = Chooser(QUANTILES, MODEL)
    before = {"array": 80.0, "cbgroup": 140.0, "points": 1000.0}
    assert run(chooser, before, 1000)["array"] > 900
    after = {"array": 150.0, "cbgroup": 100.0, "points": 1000.0}
    run(chooser, after, 40 * MOST_KEPT)
    assert run(chooser, after, 500)["cbgroup"] > 450


def test_what_is_far_too_dear_is_never_tried() -> None:
    chosen = run(Chooser(QUANTILES, MODEL), {"array": 110.0, "cbgroup": 110.0}, 20 * TRY_EVERY)
    assert set(chosen) == {"array", "cbgroup"}


def test_one_frame_that_waited_does_not_turn_the_choice() -> None:
    chooser = Chooser(QUANTILES, MODEL)
    took = {"array": 100.0, "cbgroup": 190.0}
    run(chooser, took, 20 * MOST_KEPT)
    chooser.hear(Choice("array", 300, len(KEYS), len(KEYS), 10), 1e6)
    assert run(chooser, took, 300)["array"] > 250


def test_a_choice_serves_only_frames_of_about_as_many_keys() -> None:
    """A dear descent pays for one key, and not for a hundred."""
    chooser = Chooser(QUANTILES, replace(MODEL, statement=1.0, descent=50.0, row=50.0, single=1e3))
    run(chooser, {"array": 110.0, "cbgroup": 500.0}, 3 * FEW * MOST_KEPT)
    while chooser.kept(len(KEYS)) is None:
        run(chooser, {"array": 110.0, "cbgroup": 500.0}, 1)
    assert chooser.kept(len(KEYS) - 5) == "array"
    assert chooser.kept(1) is None
    assert chooser.choose(3, KEYS[:1]).strategy == "cbgroup"


def test_where_gaps_turn_out_full_ranges_are_believed_to_cost_more() -> None:
    """By the rows that are found, before times show it; and less again where they are empty."""
    chooser = Chooser(QUANTILES, replace(MODEL, row=0.2, lookup=190.0))
    first = chooser.choose(300, KEYS)
    assert first.strategy == "cbgroup"
    for _ in range(3):
        chooser.find(first, 2000)
    assert chooser.choose(300, KEYS).strategy == "array"
    for _ in range(80):
        chooser.find(first, 0)
    assert chooser.choose(300, KEYS).strategy == "cbgroup"


def test_only_the_last_frame_of_a_turn_is_timed() -> None:
    chooser = Chooser(QUANTILES, MODEL)
    run(chooser, {"array": 110.0, "cbgroup": 150.0}, 400)
    while chooser.kept(len(KEYS)) is not None:
        pass
    chooser.choose(300, KEYS)
    listening = []
    while chooser.kept(len(KEYS)) is not None:
        listening.append(chooser.is_listening)
    assert listening[-1]
    assert not any(listening[:-1])


def test_a_strategy_that_was_disturbed_when_it_was_tried_gets_another_chance() -> None:
    """Each of its first frames, or all of them: then it takes longer to come back."""
    took = {"array": 80.0, "cbgroup": 160.0}
    chooser = Chooser(QUANTILES, MODEL)
    for spike in (1e4, 80.0, 1e4, 80.0):
        chooser.hear(Choice("array", 300, len(KEYS), len(KEYS), 10), spike)
    assert run(chooser, took, 500)["array"] > 400
    chooser = Chooser(QUANTILES, MODEL)
    for _ in range(FEW):
        chooser.hear(Choice("array", 300, len(KEYS), len(KEYS), 10), 400.0)
    run(chooser, took, 4 * LONG)
    assert run(chooser, took, 500)["array"] > 400


def test_frames_that_ask_nothing_teach_nothing() -> None:
    """A tool beside the grid has no keys; back on the part, all goes on."""
    chooser = Chooser(QUANTILES, replace(MODEL, single=1e4))
    took = {"array": 110.0, "cbgroup": 150.0}
    run(chooser, took, 50)
    none = KEYS[:0]
    for _ in range(5 * FEW):
        kept = chooser.kept(0)
        if kept is None:
            chooser.find(chooser.choose(300, none), 0)
        elif chooser.is_listening:
            chooser.hear(Choice(kept, 300, 0, 0, 0), 5.0)
    assert run(chooser, took, 400)["array"] > 200
