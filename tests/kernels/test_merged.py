"""Broad contacts of the coupling, merged as sessions on a GPU merge them."""

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from closed_forms import Field, Hand, field_of, plane, punch, sheet

Floats = NDArray[np.float64]
NEEDS_JIT = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="too slow without the JIT")
SIZE = 0.005
FROM = 128
"""Near points from which these tests merge."""
RISE = np.array([0.0, 0.0, 0.03])


def in_curve_order(points: Floats) -> Floats:
    """Points sorted along a Z-order curve, as shells made from files are."""
    cells = ((points - points.min(axis=0)) / np.ptp(points) * 255.0).astype(np.int64)
    codes = sum(((cells[:, a] >> b) & 1) << (3 * b + a) for a in range(3) for b in range(8))
    ordered: Floats = points[np.argsort(codes, kind="stable")]
    return ordered


def hand_over(field: Field, points: Floats, at: Floats, **follower: int) -> Hand:
    """A hand that rests 30 mm above a place, with numbers of its follower set."""
    hand = Hand(field, points, at + RISE)
    for name, number in follower.items():
        hand.follower[name] = number
    hand.advance()
    return hand


def press(hand: Hand, at: Floats, slide: float = 0.0) -> Floats:
    """Come down to a place in 40 periods, slide aside in 40; all forces (80, 3), N."""
    ways = [*(RISE * (1.0 - s) for s in np.linspace(0.0, 1.0, 40))]
    ways += [np.array([slide * s, 0.0, 0.0]) for s in np.linspace(0.0, 1.0, 40)]
    return np.array([hand.move(at + way) for way in ways])


BROAD = in_curve_order(punch(40, 0.002))
PRESSED = np.array([0.0, 0.0, 1.5 * SIZE - 0.004])
"""Place at which a flat tool over the plane z = 0 is 4 mm deep."""


@NEEDS_JIT
def test_merged_contacts_same_stiffness_on_plane() -> None:
    """Force = stiffness times depth, to the accuracy of stored distances; no force aside."""
    field = field_of(plane([0.0, 0.0, 1.0]), SIZE)
    single = hand_over(field, BROAD, PRESSED)
    merged = hand_over(field, BROAD, PRESSED, merges_from=FROM)
    one, other = press(single, PRESSED, 0.02), press(merged, PRESSED, 0.02)
    assert merged.follower["merged"] > 1
    assert FROM // 2 < merged.sent.contacts <= FROM < single.sent.contacts == len(BROAD)
    assert other[-1, 2] == pytest.approx(4.0, rel=0.01, abs=1000.0 * SIZE * 2.75 / 508)
    np.testing.assert_allclose(other, one, atol=0.03)
    np.testing.assert_allclose(merged.sent.wrench[3:], single.sent.wrench[3:], atol=2e-4)


@NEEDS_JIT
def test_merged_contacts_below_threshold_same_bits() -> None:
    field = field_of(plane([0.0, 0.0, 1.0]), SIZE)
    few = hand_over(field, BROAD, PRESSED, merges_from=len(BROAD) + 1)
    never = hand_over(field, BROAD, PRESSED)
    assert press(few, PRESSED, 0.02).tobytes() == press(never, PRESSED, 0.02).tobytes()
    assert few.state.tobytes() == never.state.tobytes()


@NEEDS_JIT
def test_merged_contacts_split_on_lift() -> None:
    field = field_of(plane([0.0, 0.0, 1.0]), SIZE)
    hand = hand_over(field, BROAD, PRESSED, merges_from=FROM)
    press(hand, PRESSED)
    for share in np.linspace(0.0, 1.0, 40):
        force = hand.move(PRESSED + share * RISE)
        assert force[2] >= 0.0
    hand.rest(10)
    assert hand.follower["merged"] == 1
    assert not hand.sent.wrench.any()


@NEEDS_JIT
@pytest.mark.parametrize("speed", [0.5, 5.0, 50.0])
def test_merged_contacts_never_cross_sheet(speed: float) -> None:
    """A broad tilted tool is thrown at a sheet without thickness: all points stay above it."""
    field = field_of(sheet([0.0, 0.0, 1.0]), SIZE)
    start = np.array([0.0, 0.0, 0.04])
    hand = Hand(field, BROAD, start, (0.995, 0.0995, 0.0, 0.0))
    hand.follower["merges_from"] = FROM
    hand.advance()
    for n in range(1, 120):
        hand.move(start - [0.0, 0.0, min(speed * 1e-3 * n, 0.12)])
        assert hand.placed[:, 2].min() > 0.0
    assert hand.follower["merged"] > 1
