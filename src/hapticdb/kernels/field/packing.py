"""Lossless packing of distance rows: Lorenzo prediction, then few bits a residual.

A row (`lattice`) is 10 planes of 10 lines of 10 values. Each value is predicted from the 7 before
it in its cube of 2^3, with 255 outside the row: the three-dimensional Lorenzo predictor of Ibarria,
Lindstrom, Rossignac and Szymczak, "Out-of-core compression and decompression of large n-dimensional
scalar fields", 2003. The residual, modulo 256, is 0 beyond the band, and for a distance that is a
sum of functions of two coordinates each, as along a flat surface.

The bits of a row, from the least significant bit of each byte on, are, for each plane:

- a bit: 1 if every line's mask equals that of the same line in the plane before;
- for each line, its mask, unless that bit is 1, and then its nonzero residuals.

A mask has a bit for each value of the line, 1 for a nonzero residual. Masks before the first line
or plane are 0. A mask is coded as

- 0: that of the plane before;
- 1, 0: that of the line before, only if the two differ;
- 1, if they are equal, or 1, 1: another; its 10 bits follow.

A residual r of -127 to 128 is the number 2 r - 1 if r is positive, and -2 r if not. Its highest bit
has number n; 3 bits for n and the n bits below it are stored. A row ends at a whole byte; the
remaining bits are 0.

No row takes more than `MOST_ROW_BYTES`, for any bits. `unpack` copies the bytes of one row into a
buffer of that size, so damaged bytes give wrong distances and never an access beyond an array. A
row with more or fewer bytes than its bits need is damaged.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import BOOLS, BYTES, BYTES2, INT, INTS, READ_BYTES, entry, leaf, maker
from hapticdb.kernels.bits import lowest_bit
from hapticdb.kernels.field.lattice import BEYOND, ROW_SIDE, ROW_VALUES

LINES = ROW_SIDE * ROW_SIDE
"""Lines of a row."""
PADDED = ROW_SIDE + 1
"""Side of a padded row, with one value before it on each axis."""
MOST_ROW_BYTES = (ROW_SIDE + LINES * 12 + ROW_VALUES * 10 + 7) // 8
"""Most bytes of a packed row: 1 bit a plane, 12 a mask, 10 a residual."""
ROWS_AT_ONCE = 2048
"""Rows of a batch, with a buffer of 3 MB. Fewer: less memory, more calls."""
LOW_BITS = np.uint64(0x7F7F7F7F7F7F7F7F)
"""The seven low bits of each of eight bytes."""
ALL_BEYOND = np.uint64(BEYOND * 0x0101010101010101)
"""Eight values outside the row."""
EACH_BYTE = np.uint64(0x0101010101010101)
"""Factor that copies a byte into each of eight bytes."""
NONE, ONE = np.uint64(0), np.uint64(1)
FULL_MASK = np.uint64((1 << ROW_SIDE) - 1)
"""Mask of a line without a residual of 0."""


def _codes() -> NDArray[np.uint64]:
    """Code and its length in bits (2, 256) of each residual modulo 256; length 0 for 0."""
    codes = np.zeros((2, 256), np.uint64)
    for residual in range(1, 256):
        number = 2 * residual - 1 if residual <= 128 else 2 * (256 - residual)
        n = number.bit_length() - 1
        codes[:, residual] = n | (number - (1 << n)) << 3, n + 3
    return codes


CODES = _codes()


@leaf
def _put_bits(out, at, buffer, n_buffered, value, n):
    """Append the n bits of value to the bit buffer `buffer`; 32 of them move to out[at ...]."""
    buffer |= value << n_buffered
    n_buffered += n
    # at most 31 bits stay, so a code of 12 more fits the 64-bit buffer
    if n_buffered >= np.uint64(32):
        for _ in range(4):
            out[at] = buffer & np.uint64(255)
            buffer >>= np.uint64(8)
            at += ONE
        n_buffered -= np.uint64(32)
    return at, buffer, n_buffered


@leaf
def _place_padded(line):
    """Index of a line's first value in a padded row (11^3,)."""
    return ((line // ROW_SIDE + 1) * PADDED + line % ROW_SIDE + 1) * PADDED + 1


@leaf
def _set_residuals(values, n, padded, residuals):
    """Set the residuals of row n of values (R, 1000), in the padded layout.

    padded, residuals (11^3,) uint8. One loop without branches, which LLVM vectorises.
    """
    # the padding stays BEYOND: the predictor reads 255 outside the row without a test
    for line in range(LINES):
        to = _place_padded(line)
        for z in range(ROW_SIDE):
            padded[to + z] = values[n, line * ROW_SIDE + z]
    y, x = PADDED, PADDED * PADDED
    for at in range(x + y + 1, x * PADDED):
        here = np.int64(padded[at]) - padded[at - 1] - padded[at - y] + padded[at - y - 1]
        back = np.int64(padded[at - x]) - padded[at - x - 1]
        back = back - padded[at - x - y] + padded[at - x - y - 1]
        # padding between lines gets residuals, too: unread, and cheaper than a branch
        residuals[at] = (here - back) & 255


@leaf
def _set_masks(residuals, masks):
    """Set the mask of each line, masks (100,) uint64."""
    for line in range(LINES):
        at = _place_padded(line)
        mask = NONE
        for z in range(ROW_SIDE):
            mask |= np.uint64(residuals[at + z] != 0) << np.uint64(z)
        masks[line] = mask


@leaf
def _put_mask(out, at, buffer, n_buffered, mask, back, up):
    """Append a line's mask, given those of the plane before and of the line before."""
    if mask == back:
        return _put_bits(out, at, buffer, n_buffered, NONE, ONE)
    # with equal predictions the second bit would carry nothing
    if back == up:
        return _put_bits(out, at, buffer, n_buffered, (mask << ONE) | ONE, np.uint64(11))
    if mask == up:
        return _put_bits(out, at, buffer, n_buffered, ONE, np.uint64(2))
    return _put_bits(
        out, at, buffer, n_buffered, (mask << np.uint64(2)) | np.uint64(3), np.uint64(12)
    )


@leaf
def _put_residuals(out, at, buffer, n_buffered, residuals, line, mask):
    """Append the nonzero residuals of a line."""
    first = np.uint64(_place_padded(line))
    while mask:
        residual = residuals[first + np.uint64(lowest_bit(np.int64(mask)))]
        mask &= mask - ONE  # clear the lowest set bit
        code, n = CODES[0, residual], CODES[1, residual]
        at, buffer, n_buffered = _put_bits(out, at, buffer, n_buffered, code, n)
    return at, buffer, n_buffered


@leaf
def _is_like_before(masks, first):
    """Whether the masks of the plane from line `first` on are those of the plane before."""
    for line in range(first, first + ROW_SIDE):
        if masks[line] != (masks[line - ROW_SIDE] if first else NONE):
            return False
    return True


@leaf
def _pack_row(masks, residuals, out, at):
    """Write the packed bytes of a row to out from `at` on; return where they end."""
    buffer = n_buffered = NONE
    for first in range(0, LINES, ROW_SIDE):
        is_same = _is_like_before(masks, first)
        at, buffer, n_buffered = _put_bits(out, at, buffer, n_buffered, np.uint64(is_same), ONE)
        # prediction starts anew in each plane: `up` is the line before in the same plane
        up = NONE
        for line in range(first, first + ROW_SIDE):
            mask = masks[line]
            if not is_same:
                back = masks[line - ROW_SIDE] if first else NONE
                at, buffer, n_buffered = _put_mask(out, at, buffer, n_buffered, mask, back, up)
            if mask:
                at, buffer, n_buffered = _put_residuals(
                    out, at, buffer, n_buffered, residuals, line, mask
                )
            up = mask
    for _ in range(0, np.int64(n_buffered), 8):
        out[at] = buffer & np.uint64(255)
        buffer >>= np.uint64(8)
        at += ONE
    return at


@entry(BYTES2, INT, INTS, BYTES)
def pack_kernel(values, first, ends, out):
    """Pack rows of values (R, 1000) from row `first` on; return the number of bytes written.

    ends (P,) sets the number of rows, and receives their ends in out, which has room for P times
    `MOST_ROW_BYTES`.
    """
    # filled once: a row overwrites its own values alone, never the padding
    padded = np.full(PADDED**3, BEYOND, np.uint8)
    residuals = np.empty(PADDED**3, np.uint8)
    masks = np.empty(LINES, np.uint64)
    at = NONE
    for n in range(ends.shape[0]):
        _set_residuals(values, first + n, padded, residuals)
        _set_masks(residuals, masks)
        at = _pack_row(masks, residuals, out, at)
        ends[n] = np.int64(at)
    return np.int64(at)


@leaf
def _bits_at(row, at):
    """25 bits or more of a row's bytes from bit `at` on. Reads 4 bytes."""
    byte = at >> np.uint64(3)
    word = np.uint64(row[byte]) | (np.uint64(row[byte + ONE]) << np.uint64(8))
    word |= np.uint64(row[byte + np.uint64(2)]) << np.uint64(16)
    word |= np.uint64(row[byte + np.uint64(3)]) << np.uint64(24)
    return word >> (at & np.uint64(7))


@leaf
def added(a, b):
    """Bytewise sum of eight bytes in a and in b, each modulo 256."""
    # SWAR: carries stop at bit 7, whose sum is an XOR
    return ((a & LOW_BITS) + (b & LOW_BITS)) ^ ((a ^ b) & ~LOW_BITS)


@leaf
def _take_mask(row, at, back, up):
    """A line's mask, and the bit after its code."""
    word = _bits_at(row, at)
    if not word & ONE:
        return back, at + ONE
    if back == up:
        return (word >> ONE) & FULL_MASK, at + np.uint64(11)
    if not word & np.uint64(2):
        return up, at + np.uint64(2)
    return (word >> np.uint64(2)) & FULL_MASK, at + np.uint64(12)


@leaf
def below(word, n):
    """The n lowest bits of a word."""
    return word & ((ONE << n) - ONE)


@leaf
def _take_line(row, at, mask):
    """Read the nonzero residuals of a line, and sum them up along the line.

    Returns the prefix sums in bytes, 8 in the first word and 2 in the second, and the next bit.
    """
    low, high, total = NONE, NONE, NONE
    while mask:
        z = np.uint64(lowest_bit(np.int64(mask)))
        mask &= mask - ONE
        word = _bits_at(row, at)
        n = word & np.uint64(7)
        number = (ONE << n) | below(word >> np.uint64(3), n)
        at += n + np.uint64(3)
        half = (number + ONE) >> ONE
        total += half if number & ONE else np.uint64(256) - half  # modulo 256
        # prefix sum by broadcast: the running total fills the line from z to its end
        from_here = (total & np.uint64(255)) * EACH_BYTE
        if z < np.uint64(8):
            place = z << np.uint64(3)
            low = below(low, place) | (from_here << place)
            high = from_here
        else:
            place = (z - np.uint64(8)) << np.uint64(3)
            high = below(high, place) | (from_here << place)
    return low, high, at


@leaf
def _put_line(out, n, at, low, high):
    """Write a line's values to row n of out."""
    for z in range(np.uint64(8)):
        out[n, at + z] = low >> (z << np.uint64(3)) & np.uint64(255)
    out[n, at + np.uint64(8)] = high & np.uint64(255)
    out[n, at + np.uint64(9)] = high >> np.uint64(8) & np.uint64(255)


@leaf
def _unpack_row(row, masks, lines, out, n):
    """Unpack the bytes in `row` into row n of out (R, 1000); return the number of bits.

    masks (10,) and lines (20,) uint64 are the last plane's masks and values. All numbers are
    unsigned: without negative indices LLVM joins loads and stores of single bytes.
    """
    for y in range(ROW_SIDE):
        masks[y] = NONE
        # inverse Lorenzo: sums along k in `_take_line`, along j in low and high, along i in `lines`
        lines[2 * y], lines[2 * y + 1] = ALL_BEYOND, ALL_BEYOND
    at = place = some = NONE
    for _ in range(ROW_SIDE):
        is_same = _bits_at(row, at) & ONE
        at += ONE
        has_residuals = some or not is_same  # else the plane equals the one before
        up = some = NONE
        low, high = NONE, NONE  # change of the line's values from plane to plane
        for y in range(ROW_SIDE):
            if has_residuals:
                if not is_same:
                    up, at = _take_mask(row, at, masks[y], up)
                    masks[y] = up  # the next plane's prediction, and the next line's
                if masks[y]:
                    some |= masks[y]
                    low_more, high_more, at = _take_line(row, at, masks[y])
                    low, high = added(low, low_more), added(high, high_more)
                lines[2 * y] = added(lines[2 * y], low)
                lines[2 * y + 1] = added(lines[2 * y + 1], high)
            _put_line(out, n, place, lines[2 * y], lines[2 * y + 1])
            place += np.uint64(ROW_SIDE)
    return np.int64(at)


@maker
def unpacking_memory():
    """Scratch of `unpack_one`."""
    # 4 spare bytes: `_bits_at` reads a whole word at the last bit
    row = np.zeros(MOST_ROW_BYTES + 4, np.uint8)
    return row, np.empty(ROW_SIDE, np.uint64), np.empty(2 * ROW_SIDE, np.uint64)


@leaf
def unpack_one(data, ends, n, memory, out, to):
    """Unpack row n of packed rows into row `to` of out (R, 1000); whether it is sound.

    data (n,), ends (R,) : as from `pack`, or damaged; memory : of `unpacking_memory`.
    """
    row, masks, lines = memory
    start = ends[n - 1] if n else np.int64(0)
    size = ends[n] - start
    # before any access: `ends` may be damaged as well
    if start < 0 or size < 1 or size > MOST_ROW_BYTES or ends[n] > data.shape[0]:
        return False
    first = np.uint64(start)
    # copied: bytes behind the row's end are inside this buffer, whatever the bits say
    for byte in range(np.uint64(size)):
        row[byte] = data[first + byte]
    n_bits = _unpack_row(row, masks, lines, out, np.uint64(to))
    # sound only if the bits end in the last byte, with zeros behind them
    return (n_bits + 7) >> 3 == size and np.int64(row[size - 1]) >> (((n_bits - 1) & 7) + 1) == 0


@entry(READ_BYTES, INTS, BOOLS, BYTES2)
def unpack_kernel(data, ends, wanted, out):
    """Unpack the selected rows; return the first damaged one of them, or -1.

    data (n,), ends (R,) : as from `pack`; wanted (R,) bool; out (R, 1000), unchanged in the other
    rows.
    """
    memory = unpacking_memory()
    for n in range(ends.shape[0]):
        if wanted[n] and not unpack_one(data, ends, n, memory, out, n):
            return n
    return -1


def pack(values: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Packed bytes (n,) of rows of distances (R, 1000), and the end of each row in them (R,).

    Equal rows give equal bytes, independent of other rows.
    """
    rows = np.ascontiguousarray(values, dtype=np.uint8).reshape(-1, ROW_VALUES)
    ends = np.empty(len(rows), dtype=np.int64)
    out = np.empty(min(len(rows), ROWS_AT_ONCE) * MOST_ROW_BYTES, dtype=np.uint8)
    pieces: list[NDArray[np.uint8]] = []
    n_bytes = 0
    for first in range(0, len(rows), ROWS_AT_ONCE):
        some = ends[first : first + ROWS_AT_ONCE]
        size = pack_kernel(rows, first, some, out)
        # `some` is a view: it turns the batch's ends into the whole data's
        some += n_bytes
        n_bytes += size
        pieces.append(out[:size].copy())
    return np.concatenate(pieces) if pieces else np.empty(0, dtype=np.uint8), ends


def unpack(
    data: NDArray[np.uint8], ends: NDArray[np.int64], wanted: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """Rows of distances (R, 1000), selected by `wanted` (R,), or all; the others are unset.

    data (n,) and ends (R,), as from `pack` or damaged, and `wanted` are contiguous.

    Raises
    ------
    ValueError
        If the bytes of a selected row are no packed row, or an end lies outside the data. Not every
        damage is detected, since many changed rows are rows, too.
    """
    if data.flags.writeable:
        data = data.view()
        data.flags.writeable = False
    chosen = np.ones(len(ends), dtype=np.bool_) if wanted is None else wanted
    out = np.empty((len(ends), ROW_VALUES), dtype=np.uint8)
    damaged = unpack_kernel(data, ends, chosen, out)
    if damaged >= 0:
        raise ValueError(f"row {damaged} of {len(ends)} packed rows of distances is damaged")
    return out
