"""Messages of contact proxies: what is packed is read again, and nothing malformed is accepted."""

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb.errors import ProtocolError
from hapticdb.protocol import contacts
from hapticdb.protocol.contacts import (
    MOST_PLANES,
    PLANE,
    HandState,
    ProxyState,
    ProxyTerms,
    ProxyWish,
    pack_hand,
    pack_proxy,
    pack_terms,
    pack_wish,
    unpack_hand,
    unpack_proxy,
    unpack_terms,
    unpack_wish,
)
from hapticdb.protocol.header import LAYOUT

Floats = NDArray[np.float64]
UNPACK = (unpack_hand, unpack_proxy, unpack_terms, unpack_wish)
singles = st.floats(-1e5, 1e5, width=32)
doubles = st.floats(-1e5, 1e5)
counts = st.integers(0, 2**32 - 1)


def units() -> st.SearchStrategy[Floats]:
    """Quaternions of unit length, as single precision holds them."""

    def made(numbers: list[float]) -> Floats:
        vector = np.array(numbers) + np.array([2.0, 0.0, 0.0, 0.0])
        return np.asarray(vector / np.linalg.norm(vector))

    return st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).map(made)


def vectors(n: int, of: st.SearchStrategy[float] = singles) -> st.SearchStrategy[Floats]:
    return st.lists(of, min_size=n, max_size=n).map(np.array)


hands = st.builds(
    HandState, counts, doubles, vectors(3, doubles), units(), vectors(6), counts, counts,
    st.booleans(),
)  # fmt: skip


def planes_of(raw: bytes) -> NDArray[np.void]:
    return np.frombuffer(raw[: len(raw) // PLANE.itemsize * PLANE.itemsize], PLANE).copy()


def symmetric(lower: Floats) -> Floats:
    matrix = np.zeros((6, 6))
    matrix[contacts.LOWER] = lower
    matrix.T[contacts.LOWER] = lower
    return matrix


proxies = st.builds(
    ProxyState, counts, st.integers(-1, 2**62), counts, doubles, st.floats(0, 100, width=32),
    doubles, st.integers(0, 7), st.floats(0, 1000, width=32), vectors(3, doubles), units(),
    vectors(3), units(), vectors(6), vectors(21).map(symmetric), st.floats(0, 1e5, width=32),
    st.floats(0, 1e5, width=32),
    st.binary(max_size=MOST_PLANES * PLANE.itemsize).map(planes_of),
)  # fmt: skip


def same(one: object, two: object) -> None:
    """Two messages have equal fields; quaternions to single precision."""
    for name, value in vars(one).items():
        other = getattr(two, name)
        if "quaternion" in name:
            assert value == pytest.approx(other, abs=1e-6)
        elif isinstance(value, np.ndarray):
            assert np.array_equal(value, other)
        else:
            assert value == other


@given(hands)
def test_a_hand_is_read_as_it_was_packed(hand: HandState) -> None:
    message = pack_hand(hand)
    assert len(message) == 100
    same(hand, unpack_hand(message))


@given(proxies)
def test_a_proxy_is_read_as_it_was_packed(proxy: ProxyState) -> None:
    message = pack_proxy(proxy)
    assert len(message) == 232 + 24 * len(proxy.planes)
    same(proxy, unpack_proxy(message))


def test_wish_and_terms_are_read_as_they_were_packed() -> None:
    wish = ProxyWish("Schlüssel", 800.0, 0.0, 3.3, 0.0)
    assert unpack_wish(pack_wish(wish)) == wish
    terms = ProxyTerms("a", (1.0, -2.0, 3.0), 0.1, 1e3, 2.0, 7.0, 0.5, 5e4, 1e-3, 1.5e-3, 0.01)
    assert unpack_terms(pack_terms(terms)) == terms


@pytest.mark.parametrize(
    ("name", "value", "is_read"),
    [
        ("contact", 3.4e7, True),  # 7 N in voxels of 1 um
        ("contact", 2e12, False),
        ("cap", 2e6, False),
        ("period", 0.0, False),
    ],
)
def test_terms_have_numbers_in_their_ranges(name: str, value: float, is_read: bool) -> None:
    terms = ProxyTerms("a", (1.0, -2.0, 3.0), 0.1, 1e3, 2.0, 7.0, 0.5, 5e4, 1e-3, 1.5e-3, 0.01)
    given: dict[str, Any] = {name: value}
    message = pack_terms(terms._replace(**given))
    if is_read:
        assert getattr(unpack_terms(message), name) == value
    else:
        with pytest.raises(ProtocolError, match=f"a WELCOME whose {name} is .* above 0"):
            unpack_terms(message)


@given(st.one_of(st.binary(max_size=700), hands.map(pack_hand), proxies.map(pack_proxy)), st.data())
def test_any_bytes_are_read_or_refused(message: bytes, data: st.DataObject) -> None:
    """Only ProtocolError is raised, and a message that is read has finite numbers alone."""
    damaged = bytearray(message)
    for _ in range(data.draw(st.integers(0, 4))):
        if damaged:
            damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(damaged[: data.draw(st.integers(0, len(damaged)))])
    for message_read in (bytes(damaged), cut):
        for unpack in UNPACK:
            try:
                found = unpack(message_read)
            except ProtocolError:
                continue
            values = found if isinstance(found, tuple) else vars(found).values()
            for value in values:
                if isinstance(value, np.ndarray) and value.dtype == np.float64:
                    assert np.isfinite(value).all()


def proxy_of(n: int = 2) -> ProxyState:
    return ProxyState(
        1, 2, 3, 4.0, 5.0, 6.0, 0, 0.1, np.zeros(3), np.eye(4)[0], np.zeros(3), np.eye(4)[0],
        np.zeros(6), np.eye(6), 1.0, 1.0, np.zeros(n, PLANE),
    )  # fmt: skip


def test_places_of_surveys_are_read() -> None:
    hand = HandState(1, 0.0, np.array([5e5, 4.9e6, -1e9]), np.eye(4)[0], np.zeros(6))
    np.testing.assert_array_equal(unpack_hand(pack_hand(hand)).position, hand.position)


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e30])
def test_a_number_that_is_not_finite_or_too_large_is_refused(value: float) -> None:
    hand = vars(HandState(1, 0.0, np.zeros(3), np.eye(4)[0], np.zeros(6)))
    wrong = np.array([0.0, value, 0.0])
    hands: list[dict[str, Any]] = [{"position": wrong}, {"velocity": np.tile(wrong, 2)}]
    proxies: list[dict[str, Any]] = [{"wrench": np.tile(wrong, 2)}]
    if not np.isfinite(value):
        hands += [{"clock": value}]
        proxies += [{name: value} for name in ("clock", "echo_clock", "kept")]
    for change in hands:
        with pytest.raises(ProtocolError):
            unpack_hand(pack_hand(HandState(**{**hand, **change})))
    for change in proxies:
        with pytest.raises(ProtocolError):
            unpack_proxy(pack_proxy(ProxyState(**{**vars(proxy_of()), **change})))
    if not value <= 1e6:
        with pytest.raises(ProtocolError):
            unpack_wish(pack_wish(ProxyWish("a", value)))


def test_a_quaternion_without_unit_length_is_refused() -> None:
    bad = HandState(1, 0.0, np.zeros(3), np.array([1.0, 0.1, 0.0, 0.0]), np.zeros(6))
    with pytest.raises(ProtocolError, match="length 1"):
        unpack_hand(pack_hand(bad))


def test_counts_and_lengths_are_not_trusted() -> None:
    message = bytearray(pack_proxy(proxy_of()))
    for count in (1, 3, 65535):
        struct.pack_into("<H", message, LAYOUT.size + 6, count)
        with pytest.raises(ProtocolError):
            unpack_proxy(bytes(message))
    message = bytearray(pack_wish(ProxyWish("abc")))
    for length in (0, 2, 4, 1 << 20, 0xFFFFFFFF):
        struct.pack_into("<I", message, LAYOUT.size, length)
        with pytest.raises(ProtocolError, match="not those of its fields"):
            unpack_wish(bytes(message))
