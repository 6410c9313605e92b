"""Batches of rows: an empty one, and several as one."""

from collections.abc import Sequence

import numpy as np

from hapticdb.store.base import NO_KEYS, NO_OCCUPANCY, NO_ROWS, Band, Rows

NO_DISTANCES = NO_ROWS.having(Band(NO_OCCUPANCY, NO_KEYS))


def no_rows(*, distances: bool) -> Rows:
    """Build the answer of a read that finds nothing."""
    return NO_DISTANCES if distances else NO_ROWS


def joined(parts: Sequence[Rows], *, distances: bool) -> Rows:
    """Batches of rows as one, in their order; all with distances or all without."""
    if not parts:
        return no_rows(distances=distances)
    bits = np.frombuffer(b"".join([part.occupancy.tobytes() for part in parts]), np.uint8)
    bands = [part.distances for part in parts if part.distances is not None]
    band = None
    if distances:
        data = np.frombuffer(b"".join([one.data.tobytes() for one in bands]), np.uint8)
        band = Band(data, np.cumsum(np.concatenate([one.lengths for one in bands])))
    keys, ids = (np.concatenate([part[column] for part in parts]) for column in (0, 1))
    return Rows(keys, ids, bits, band)
