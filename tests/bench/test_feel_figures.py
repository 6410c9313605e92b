"""Figures of the feel on signals whose figures are known."""

import math

import numpy as np
import pytest

from hapticdb.bench.feel.figures import (
    energy_given,
    is_limit_cycle,
    largest_step,
    overshoot,
    ripple,
    spectrum,
)
from hapticdb.bench.feel.measures import MEASURES, Measure, number_text
from hapticdb.bench.feel.page import missed_lines, table_of
from hapticdb.bench.feel.touching import worst_ripple
from hapticdb.bench.feel.walking import trembling

TIMES = np.arange(0.0, 2.0, 1e-3)


def test_a_saw_tooth_has_the_ripple_of_a_uniform_distribution() -> None:
    teeth = np.arange(10_000) % 100 / 99.0
    assert ripple(teeth) == pytest.approx(1.0 / math.sqrt(3.0), rel=0.02)
    assert largest_step(teeth) == 1.0


def test_a_wave_has_the_ripple_of_its_amplitude() -> None:
    assert ripple(2.0 + 0.1 * np.sin(2.0 * np.pi * TIMES)) == pytest.approx(0.05 / math.sqrt(2.0))


def test_a_force_that_is_never_felt_has_no_ripple() -> None:
    assert ripple(np.zeros(10)) == math.inf
    assert worst_ripple([0.2, math.inf, 0.1]) == 0.2


def test_a_step_is_found_within_its_reach() -> None:
    slow = np.array([0.0, 1.0, 2.0, 3.0, 3.0])
    assert largest_step(slow) == 1.0
    assert largest_step(slow, apart=2) == 2.0
    assert largest_step(np.array([[0.0, 0.0], [3.0, 4.0]])) == 5.0
    assert largest_step(np.array([1.0])) == 0.0


@pytest.mark.parametrize("ratio", [0.1, 0.35, 0.7])
def test_the_overshoot_of_a_damped_oscillator_is_the_known_one(ratio: float) -> None:
    """Step response of x'' + 2 D x' + x = 1: overshoot exp(-pi D / sqrt(1 - D^2))."""
    damped = math.sqrt(1.0 - ratio**2)
    times = np.linspace(0.0, 20.0, 200_000)
    swing = np.cos(damped * times) + ratio / damped * np.sin(damped * times)
    response = 1.0 - np.exp(-ratio * times) * swing
    expected = math.exp(-math.pi * ratio / damped)
    assert overshoot(response, 1.0) == pytest.approx(expected, rel=1e-6)
    assert overshoot(response, 0.0) == math.inf


@pytest.mark.parametrize(
    ("decay", "size", "is_found"),
    [
        (0.0, 0.06, True),
        (0.0, 0.04, False),  # smaller than a limit cycle
        (3.0, 1.0, False),  # exp(-0.6) = 0.55 of its size is left after a window
        (1.0, 1.0, True),  # exp(-0.2) = 0.82
        (-1.0, 0.1, True),
    ],
)
def test_an_oscillation_that_stays_is_a_limit_cycle(
    decay: float, size: float, *, is_found: bool
) -> None:
    times = TIMES[:1000]
    wave = 5.0 + size * np.exp(-decay * (times - 0.9)) * np.sin(2.0 * np.pi * 50.0 * times)
    assert is_limit_cycle(wave, 200) is is_found


def test_a_force_that_is_no_number_counts_as_a_limit_cycle() -> None:
    assert is_limit_cycle([0.0] * 300 + [math.nan] * 100, 200)


def test_a_spring_that_is_held_over_a_period_gives_its_known_energy() -> None:
    """A sampled spring gives K T/2 times the integral of v^2 dt, however the hand moves."""
    period, stiffness = 1e-3, 1000.0
    depths = 0.0025 - 0.0025 * np.cos(4.0 * np.pi * np.arange(0.0, 0.5 + period, period))
    positions = np.column_stack([np.zeros((len(depths), 2)), -depths])
    forces = np.column_stack([np.zeros((len(depths), 2)), stiffness * depths])
    squares = np.sum((np.diff(depths) / period) ** 2) * period
    assert energy_given(forces, positions) == pytest.approx(stiffness * period / 2 * squares)


def test_a_damper_takes_energy() -> None:
    positions = np.column_stack([np.sin(TIMES), np.zeros((len(TIMES), 2))])
    forces = np.column_stack([-np.cos(TIMES), np.zeros((len(TIMES), 2))])
    assert energy_given(forces, positions) < 0.0


def test_the_spectrum_of_a_sine_has_its_amplitude() -> None:
    found = spectrum(3.0 + 0.5 * np.sin(2.0 * np.pi * 40.0 * TIMES), 1000.0)
    at = int(np.argmax(found.amplitudes))
    assert found.frequencies[at] == pytest.approx(40.0)
    assert found.amplitudes[at] == pytest.approx(0.5, rel=0.01)
    assert found.amplitudes[found.frequencies > 45.0].max() < 0.005


def test_only_fast_parts_of_a_force_tremble() -> None:
    slow, fast = np.sin(2.0 * np.pi * 5.0 * TIMES), 0.1 * np.sin(2.0 * np.pi * 100.0 * TIMES)
    forces = np.column_stack([slow, slow + fast, np.ones(len(TIMES))])
    assert trembling(forces) == pytest.approx(0.1 / math.sqrt(2.0), rel=1e-3)


# --- the table ------------------------------------------------------------------------------------


def test_a_value_beyond_its_limit_is_missed() -> None:
    by_limit = Measure("a", "a", "how", "<= 2 / 1 %", (0.02, 0.01), percent=True)
    assert not by_limit.missed({"values": [0.02, 0.01]})
    assert by_limit.missed({"values": [0.01, 0.011]})
    assert by_limit.missed({"values": [0.01, math.nan]})
    floor = Measure("b", "b", "how", ">= 0 N", (0.0,), is_floor=True)
    assert floor.missed({"values": [-0.1]})
    assert not floor.missed({"values": [0.0]})
    assert not Measure("c", "c", "how").missed({"values": [1e9]})


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1e-9, "1e-09"), (0.0123, "0.012"), (9.96, "9.96"), (1234.5, "1,234")],
)
def test_numbers_have_few_digits(value: float, text: str) -> None:
    assert number_text(value) == text


def test_the_table_has_both_laws_and_names_what_is_missed() -> None:
    cells = [
        {"measure": "touch_step", "law": "plane", "values": [24.9]},
        {"measure": "touch_step", "law": "smooth", "values": [0.01]},
        {"measure": "session_lift", "law": "smooth", "values": [-0.5]},
    ]
    lines = table_of(cells).splitlines()
    assert lines[0] == "| measure | plane | smooth | wanted |"
    assert "| **24.9 N** | 0.01 N | <= 0.05 N |" in lines[2]
    assert "| - | **-0.5 N** | >= 0 N |" in lines[3]
    (missed,) = missed_lines(cells)
    assert missed.endswith("-0.5 N, wanted >= 0 N")


def test_every_measure_says_how_it_is_taken() -> None:
    assert len({measure.key for measure in MEASURES}) == len(MEASURES)
    for measure in MEASURES:
        assert len(measure.how) > 60, measure.key
        assert bool(measure.limits) == bool(measure.wanted), measure.key
