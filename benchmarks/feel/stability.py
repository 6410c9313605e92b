"""Measures with a simulated person in the loop: a tap, and the stiffest wall that stays at rest.

The hand and the device's end are one mass on a spring and a damper, pushed by the device, on a
counted clock. Grip and device are linear, so a period under constant force is stepped exactly, by
the exponential of a matrix; nothing is lost to integration.
"""

from collections import deque
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from feel.ground import Floats, Ground, Stand, flat_tool, on_slope, posed
from feel.hands import ABOVE, USUAL, CoupledHand, Terms

DEVICE_KG = 0.1
"""Mass of the device's end and the fingers that move with it, kg."""
DEVICE_DAMPING = 0.2
"""Damping of the device itself, N s/m: a light, well-made one. Larger: stiffer walls are stable."""
TAP_SPEED, TAP_HEIGHT, TAP_DEPTH = 0.3, 0.03, 0.01
"""Speed of a tapping arm, m/s; height above and depth below the onset between which it taps, m."""
TAP_SECONDS = 1.0
"""Time after which a tap has come to rest, seconds."""
REST_DEPTH = 0.005
"""Depth below the onset that the arm of a resting hand aims at, metres."""
REST_SECONDS = 1.2
"""Time of a resting hand that is measured, seconds. Larger: slowly growing cycles are seen."""
WINDOW_SECONDS = 0.2
"""Length of each of the two windows that are compared, seconds."""
CYCLE_N = 0.1
"""Least force, N peak to peak, of a limit cycle. Smaller: a decaying oscillation may be taken for a
limit cycle."""
CYCLE_SHARE = 0.7
"""Least share of its size that an oscillation keeps from one window to the next to be a limit
cycle. Larger: a slowly decaying oscillation counts as stable."""
SOFTEST, STIFFEST = 50.0, 20000.0
"""Range of stiffness that is tried, N/m; devices offer less."""
TRIES = 9
"""Halvings of the range of stiffness, by ratios: 9 leave 1.2 % of a value."""
DELAYS = (0.0, 0.001, 0.002)
"""Delays, seconds."""
RATES = (1000.0, 5000.0)
"""Periods a second."""


class Grip(NamedTuple):
    """Stiffness, N/m, and damping, N s/m, between the device and where the arm wants it to be."""

    name: str
    stiffness: float
    damping: float


LIGHT = Grip("light grip", 100.0, 0.6 * (100.0 * DEVICE_KG) ** 0.5)
FIRM = Grip("firm grip", 1000.0, (1000.0 * DEVICE_KG) ** 0.5)
"""The two grips: damped by 0.3 and 0.5 of the critical damping."""


def step_matrix(grip: Grip, period: float) -> Floats:
    """Matrix (2, 5) from (x, v, force, target, target's speed) to (x, v) one period later."""
    k, b, m = grip.stiffness, grip.damping, DEVICE_KG
    rates = np.zeros((5, 5))
    rates[0, 1] = 1.0
    rates[1] = -k / m, -(b + DEVICE_DAMPING) / m, 1.0 / m, k / m, b / m
    rates[3, 4] = 1.0
    return np.asarray(expm(rates * period)[:2])


def live(
    ground: Ground, stand: Stand, grip: Grip, terms: Terms, start: float, depths: Floats
) -> Floats:
    """Normal forces (M,) while the arm aims at depths (M,), one a period, from a rest at `start`.

    A force is sent at a period's start and acts after the delay; the arm moves to the next depth at
    a constant speed. All is not a number from where a force is not finite.
    """
    period = 1.0 / terms.rate
    target = position = stand.at(start)
    tool = flat_tool(3, ground.size, stand.axes)
    hand, velocity = CoupledHand(ground, tool, target, terms), np.zeros(3)
    under_way = deque([np.zeros(3)] * round(terms.delay / period))
    matrix, forces = step_matrix(grip, period), np.full(len(depths), np.nan)
    for n, depth in enumerate(depths):
        force = hand.step(posed(position), np.concatenate([velocity, np.zeros(3)]))
        if not (np.isfinite(force).all() and np.abs(position).max() < 1e3):
            break
        forces[n] = force @ stand.normal
        under_way.append(force)
        last, target = target, stand.at(depth)
        state = [position, velocity, under_way.popleft(), last, (target - last) / period]
        position, velocity = matrix @ np.stack(state)
    return forces


def tap(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Overshoot of the force when an arm with a firm grip taps a plane and rests; its curve."""
    with on_slope(folder) as (ground, stand):
        times = np.arange(1, round(TAP_SECONDS * USUAL.rate) + 1) / USUAL.rate
        depths = np.minimum(-TAP_HEIGHT + TAP_SPEED * times, TAP_DEPTH)
        normal = live(ground, stand, FIRM, USUAL, -TAP_HEIGHT, depths)
    steady, peak = float(normal[-100:].mean()), float(normal.max())
    found = {"values": [peak / steady - 1.0 if steady > 0.0 else np.inf], "steady": steady}
    return found | {"peak": peak}, {"label": "tap", "x": times.tolist(), "y": normal.tolist()}


# --- the stiffest wall ----------------------------------------------------------------------------


def stiffest(is_stable: Callable[[float], bool], tries: int = TRIES) -> float:
    """Largest stable stiffness, N/m, between `SOFTEST` and `STIFFEST`, by halving their ratio.

    0 where the softest is not stable; `STIFFEST` where the stiffest is.
    """
    if is_stable(STIFFEST):
        return STIFFEST
    if not is_stable(SOFTEST):
        return 0.0
    low, high = SOFTEST, STIFFEST
    for _ in range(tries):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if is_stable(middle) else (low, middle)
    return low


def rests(ground: Ground, stand: Stand, grip: Grip, terms: Terms) -> bool:
    """Whether a hand that presses on a plane comes to rest: no limit cycle is left.

    A limit cycle has more than `CYCLE_N` in the last window, and `CYCLE_SHARE` of the size in the
    window before. A force that is not finite counts as a limit cycle, too.
    """
    times = np.arange(1, round(REST_SECONDS * terms.rate) + 1) / terms.rate
    depths = np.minimum(-ABOVE + 0.05 * times, REST_DEPTH)
    forces = live(ground, stand, grip, terms, -ABOVE, depths)
    window = round(WINDOW_SECONDS * terms.rate)
    before, last = np.ptp(forces[-2 * window : -window]), np.ptp(forces[-window:])
    return bool(last <= CYCLE_N or last <= CYCLE_SHARE * before)


def z_width(
    folder: Path,
    rates: Sequence[float] = RATES,
    delays: Sequence[float] = DELAYS,
    tries: int = TRIES,
) -> dict[str, Any]:
    """Largest stiffness without a limit cycle for each grip, rate and delay, N/m."""
    rows = []
    with on_slope(folder) as (ground, stand):
        for grip, rate, delay in product((LIGHT, FIRM), rates, delays):

            def is_stable(
                stiffness: float, grip: Grip = grip, rate: float = rate, delay: float = delay
            ) -> bool:
                return rests(ground, stand, grip, Terms(stiffness, rate, delay))

            row = {"grip": grip.name, "rate": rate, "delay": delay}
            rows.append(row | {"stiffness": stiffest(is_stable, tries)})
    return {"values": [row["stiffness"] for row in rows], "cases": rows}
