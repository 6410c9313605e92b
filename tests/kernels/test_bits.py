"""Bits of a word: which is the lowest, and which the highest."""

from hypothesis import example, given
from hypothesis import strategies as st

from hapticdb.kernels._jit import leaf
from hapticdb.kernels.bits import highest_bit, lowest_bit


@leaf
def lowest_and_highest(word: int) -> tuple[int, int]:
    return lowest_bit(word), highest_bit(word)  # type: ignore[no-untyped-call] # numba's


@given(st.integers(1, (1 << 63) - 1))
@example((1 << 63) - 1)
@example((1 << 32) - 1)
@example(1 << 31)
@example(1)
def test_the_first_and_the_last_bit_of_a_word_are_found(word: int) -> None:
    bits = [k for k in range(63) if word >> k & 1]
    assert lowest_and_highest(word) == (bits[0], bits[-1])
