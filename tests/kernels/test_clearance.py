"""Bits of a column of voxels: which is the lowest, and which the highest."""

from hypothesis import example, given
from hypothesis import strategies as st

from hapticdb.kernels.resident.clearance import highest_bit, lowest_bit


@given(st.integers(1, (1 << 32) - 1))
@example((1 << 32) - 1)
@example(1 << 31)
@example(1)
def test_the_first_and_the_last_bit_of_a_word_are_found(word: int) -> None:
    bits = [k for k in range(32) if word >> k & 1]
    assert (lowest_bit(word), highest_bit(word)) == (bits[0], bits[-1])
