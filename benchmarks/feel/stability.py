"""Measures with a simulated person in the loop: a tap, and the stiffest wall that stays at rest."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from feel.couplings import CoupledHand, Terms, posed
from feel.figures import is_limit_cycle, overshoot
from feel.ground import Ground
from feel.person import FIRM, LIGHT, Grip, Person
from feel.scenes import plane, slope_axes
from feel.sliding import ABOVE, SIZE, Stand, stand_on
from feel.tools import flat_tool

Floats = NDArray[np.float64]

TAP_SPEED = 0.3
"""Speed of a tapping arm, m/s."""
TAP_HEIGHT = 0.03
"""Height above the onset from which an arm taps, metres."""
TAP_DEPTH = 0.01
"""Depth below the onset at which a tapping arm stops, metres."""
TAP_SECONDS = 1.0
"""Time after which a tap has come to rest, seconds."""
REST_DEPTH = 0.005
"""Depth below the onset that the arm of a resting hand aims at, metres."""
REST_SECONDS = 1.2
"""Time of a resting hand that is looked at, seconds. Larger: slowly growing cycles are seen."""
WINDOW_SECONDS = 0.2
"""Length of each of the two windows that are compared, seconds."""
STIFFEST = 20000.0
"""Largest stiffness that is tried, N/m; more than devices offer."""
SOFTEST = 50.0
"""Smallest stiffness that is tried, N/m."""
TRIES = 9
"""Halvings of the range of stiffness, by ratios: 9 leave 1.2 % of a value."""
DELAYS = (0.0, 0.001, 0.002)
"""Delays, seconds."""
RATES = (1000.0, 5000.0)
"""Periods a second."""
GRIPS = (LIGHT, FIRM)


def live(hand: CoupledHand, person: Person, targets: Floats) -> tuple[Floats, Floats]:
    """Let a person hold a hand while the arm goes along targets (M, 3), one a period.

    Returns the forces and the positions of the device, both (M, 3).
    """
    forces, positions = np.empty_like(targets), np.empty_like(targets)
    pose, velocity = np.eye(4), np.zeros(6)
    for n, target in enumerate(targets):
        pose[:3, 3], velocity[:3] = person.position, person.velocity
        positions[n] = person.position
        forces[n] = hand.step(pose, velocity)
        if not (np.isfinite(forces[n]).all() and np.abs(person.position).max() < 1e3):
            forces[n:], positions[n:] = np.nan, np.nan
            break
        person.move(forces[n], target)
    return forces, positions


def tap(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Overshoot of the force when an arm with a firm grip taps a plane and rests; its curve."""
    scene = plane("20 degrees", slope_axes(20.0))
    terms = Terms()
    with Ground.of_scenes(folder, [scene], SIZE, distances=True) as ground:
        stand = stand_on(ground, scene)
        start = stand.at(-TAP_HEIGHT)
        hand = CoupledHand(ground, flat_tool(3, SIZE, scene.axes), posed(start), terms)
        person = Person(FIRM, 1.0 / terms.rate, terms.delay, start)
        times = np.arange(1, round(TAP_SECONDS * terms.rate) + 1) / terms.rate
        depths = np.minimum(-TAP_HEIGHT + TAP_SPEED * times, TAP_DEPTH)
        forces, _ = live(hand, person, np.array([stand.at(depth) for depth in depths]))
    normal = forces @ stand.normal
    steady = float(normal[-100:].mean())
    found = {"values": [overshoot(normal, steady)], "steady": steady, "peak": float(normal.max())}
    return found, {"label": "tap", "x": times.tolist(), "y": normal.tolist()}


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
    """Whether a hand that presses on a plane comes to rest: no limit cycle is left."""
    start = stand.at(-ABOVE)
    hand = CoupledHand(ground, flat_tool(3, ground.size, stand.axes), posed(start), terms)
    person = Person(grip, 1.0 / terms.rate, terms.delay, start)
    count = round(REST_SECONDS * terms.rate)
    depths = np.minimum(-ABOVE + 0.05 * np.arange(1, count + 1) / terms.rate, REST_DEPTH)
    forces, _ = live(hand, person, np.array([stand.at(depth) for depth in depths]))
    return not is_limit_cycle(forces @ stand.normal, round(WINDOW_SECONDS * terms.rate))


def z_width(
    folder: Path,
    rates: Sequence[float] = RATES,
    delays: Sequence[float] = DELAYS,
    tries: int = TRIES,
) -> dict[str, Any]:
    """Largest stiffness without a limit cycle for each grip, rate and delay, N/m."""
    scene = plane("20 degrees", slope_axes(20.0))
    rows = []
    with Ground.of_scenes(folder, [scene], SIZE, distances=True) as ground:
        stand = stand_on(ground, scene)
        for grip in GRIPS:
            for rate in rates:
                for delay in delays:

                    def is_stable(
                        stiffness: float, *, grip: Grip = grip, rate: float = rate,
                        delay: float = delay,
                    ) -> bool:  # fmt: skip
                        terms = Terms(stiffness, rate, delay)
                        return rests(ground, stand, grip, terms)

                    rows.append(
                        {
                            "grip": grip.name,
                            "rate": rate,
                            "delay": delay,
                            "stiffness": stiffest(is_stable, tries),
                        }
                    )
    return {"values": [row["stiffness"] for row in rows], "cases": rows}
